// Passes on a time line: packets received and missing, by the mission time of their data.
import { $, brush, copyText, css, make, nice, number, short, stored, ticks, utc } from "/tools.js";

const LEFT = 72, RIGHT = 10, TOP = 6, BARS = 84, LANE = 12, SPACE = 5, ROWS = 50, DAY_S = 86400;
const NAMES = { visibilities: "visibilities", ephemeris: "positions", housekeeping: "reports", instrument: "description", calibration: "calibration" };
const ORDER = Object.keys(NAMES);

export class Passes {
  constructor(canvas) {
    this.canvas = canvas; this.line = null; this.chosen = null; this.begun = null;
    this.clock = stored("clock") === "days" ? "days" : "utc";
    $("clock").value = this.clock;
    $("clock").addEventListener("change", () => { this.clock = $("clock").value; stored("clock", this.clock); this.draw(); this.tell(); });
    $("allpasses").addEventListener("click", () => this.choose(null));
    $("copypasses").addEventListener("click", async () => {
      const done = await copyText(this.ranges().map(({ apid, from, to }) => `0x${apid.toString(16)} ${from} ${to}`).join("\n"));
      $("copypasses").textContent = done ? "copied" : "not allowed";
      setTimeout(() => { $("copypasses").textContent = "copy ranges"; }, 1500);
    });
    canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); this.begun = this.binAt(event); this.choose([this.begun, this.begun]); });
    canvas.addEventListener("pointermove", (event) => {
      const bin = this.binAt(event);
      if (this.begun !== null) this.choose([Math.min(this.begun, bin), Math.max(this.begun, bin)]);
      else if (!this.chosen) this.tell(bin);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => { this.begun = null; });
    canvas.addEventListener("pointerleave", () => { if (this.begun === null) this.tell(); });
    canvas.addEventListener("keydown", (event) => this.press(event));
  }

  bins() { return this.line?.kinds[0]?.received.length ?? 0; }

  show(line) {
    // With wider bins or another mission, the selection is no longer valid.
    if (this.line && line && (this.line.bin_s !== line.bin_s || this.line.start_s !== line.start_s)) this.chosen = null;
    this.line = line;
    this.draw(); this.tell();
  }

  choose(chosen) { this.chosen = this.bins() ? chosen : null; this.draw(); this.tell(); }

  press(event) {
    const last = this.bins() - 1, [from, to] = this.chosen ?? [-1, -1];
    if (last < 0 || event.ctrlKey || event.metaKey || event.altKey) return;
    const clamp = (bin) => Math.min(last, Math.max(0, bin)), one = (bin) => this.choose([clamp(bin), clamp(bin)]);
    const keys = {
      ArrowLeft: () => (event.shiftKey && this.chosen ? this.choose([clamp(from - 1), to]) : one(from < 0 ? last : from - 1)),
      ArrowRight: () => (event.shiftKey && this.chosen ? this.choose([from, clamp(to + 1)]) : one(to + 1)),
      Home: () => one(0), End: () => one(last), Escape: () => this.choose(null),
    };
    if (!keys[event.key]) return;
    keys[event.key]();
    event.preventDefault(); event.stopPropagation();
  }

  binAt(event) {
    const box = this.canvas.getBoundingClientRect(), share = (event.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT);
    return Math.min(this.bins() - 1, Math.max(0, Math.floor(share * this.bins())));
  }

  when(timeS, long = true) {
    if (this.clock === "utc") { const text = utc(this.line.epoch_tai_s, timeS); return long ? `${text} UTC` : text; }
    return long ? `day ${(timeS / DAY_S).toFixed(2)}` : short(timeS / DAY_S);
  }

  /** Listed ranges that may overlap the selected bins. */
  ranges() {
    if (!this.line) return [];
    const { start_s, bin_s, ranges } = this.line, bin = (t) => Math.floor((t - start_s) / bin_s);
    if (!this.chosen) return ranges;
    const [from, to] = this.chosen;
    return ranges.filter(({ between_s: [a, b] }) => bin(a) <= to && bin(b) >= from);
  }

  /** Shows the counts of the selected bins, of the bin below the mouse, or of all bins. */
  tell(below) {
    const line = this.line, last = this.bins() - 1;
    $("nopasses").hidden = last >= 0;
    if (last < 0) return;
    const [from, to] = this.chosen ?? (below === undefined ? [0, last] : [below, below]);
    const sum = (counts) => counts.slice(from, to + 1).reduce((a, b) => a + b, 0);
    const parts = ORDER.map((kind) => line.kinds.find((k) => k.kind === kind)).filter(Boolean).map((k) => {
      const [received, missing] = [sum(k.received), sum(k.missing)];
      return `${NAMES[k.kind]} ${number.format(received)} received${missing ? `, ${number.format(missing)} missing` : ""}`;
    });
    const [begin, end] = [line.start_s + from * line.bin_s, line.start_s + (to + 1) * line.bin_s];
    const span = this.chosen || below !== undefined ? `${this.when(begin)} to ${this.when(end)}: ` : "whole mission: ";
    $("passestext").textContent = span + parts.join(" · ");
    this.canvas.setAttribute("aria-label", `Packets by mission time, ${span}${parts.join(", ")}`);
    $("allpasses").hidden = !this.chosen;
    if (below !== undefined) return;
    const ranges = this.ranges(), cell = (text) => make("td", {}, text);
    $("copypasses").disabled = ranges.length === 0;
    $("rangesbox").hidden = ranges.length === 0;
    const head = make("tr", {}, ...["APID", "from", "to", "after", "before"].map((name) => make("th", { scope: "col" }, name)));
    $("ranges").replaceChildren(head, ...ranges.slice(0, ROWS).map((r) => make("tr", {}, cell(`0x${r.apid.toString(16)}`), cell(String(r.from)), cell(String(r.to)), cell(this.when(r.between_s[0])), cell(this.when(r.between_s[1])))));
    const more = line.ranges_left_out ? `; ${number.format(line.ranges_left_out)} earlier ones are not listed here` : "";
    $("rangesnote").textContent = ranges.length ? `${number.format(ranges.length)} ranges to request again, the latest first${ranges.length > ROWS ? `, ${ROWS} shown` : ""}${more}` : `Nothing is missing between the packets received${this.chosen ? " here" : ""}.`;
  }

  draw() {
    const lanes = ORDER.map((kind) => this.line?.kinds.find((k) => k.kind === kind)).filter(Boolean);
    this.canvas.style.height = `${TOP + BARS + Math.max(0, lanes.length - 1) * (LANE + SPACE) + 34}px`;
    const at = brush(this.canvas), bins = this.bins();
    if (!at || !bins) return;
    const { c, width } = at, w = width - LEFT - RIGHT, { start_s, bin_s } = this.line;
    const x = (bin) => LEFT + bin / bins * w, colours = { received: css("--cool"), missing: css("--bad") };
    const bottom = TOP + BARS + (lanes.length - 1) * (LANE + SPACE);
    c.strokeStyle = css("--line"); c.fillStyle = css("--quiet"); c.textAlign = "center";
    const [first, final] = [start_s / DAY_S, (start_s + bins * bin_s) / DAY_S], step = nice(final - first, w / (this.clock === "utc" ? 130 : 90));
    for (const day of ticks(first, final, step)) {
      const tick = LEFT + (day - first) / (final - first) * w;
      c.beginPath(); c.moveTo(tick, TOP); c.lineTo(tick, bottom + 4); c.stroke();
      const text = this.when(day * DAY_S, false);
      c.fillText(this.clock === "utc" && step >= 1 ? text.slice(0, 10) : text, Math.min(tick, width - 36), bottom + 16);
    }
    c.fillText(this.clock === "utc" ? "UTC" : "mission time, days", LEFT + w / 2, bottom + 30);
    c.textAlign = "right"; c.textBaseline = "middle";
    lanes.forEach((lane, k) => {
      const base = TOP + BARS + k * (LANE + SPACE), high = k === 0 ? BARS : LANE;
      const most = lane.received.reduce((m, r, bin) => Math.max(m, r + lane.missing[bin]), 1);
      c.fillStyle = css("--quiet"); c.fillText(NAMES[lane.kind], LEFT - 6, base - high / 2);
      c.fillStyle = css("--track"); c.fillRect(LEFT, base, w, 1);
      for (let bin = 0; bin < bins; bin++) {
        const [received, missing] = [lane.received[bin], lane.missing[bin]];
        if (!received && !missing) continue;
        const left = Math.floor(x(bin)), wide = Math.max(1, Math.ceil(x(bin + 1)) - left - (w / bins > 6 ? 1 : 0));
        // Bars are proportional to the counts; lanes are full if there is any packet. A single missing packet must be visible.
        const up = received ? Math.max(2, k === 0 ? Math.round(high * received / most) : high) : 0;
        const above = missing ? Math.max(4, Math.round(high * missing / most)) : 0;
        c.fillStyle = colours.received; c.fillRect(left, base - up, wide, up);
        c.fillStyle = colours.missing; c.fillRect(left, Math.max(base - high, base - up - above), wide, above);
      }
    });
    if (this.chosen) {
      const [from, to] = this.chosen;
      c.strokeStyle = css("--hot"); c.lineWidth = 2;
      c.strokeRect(x(from) - 1, TOP - 3, x(to + 1) - x(from) + 2, bottom - TOP + 5);
    }
  }
}
