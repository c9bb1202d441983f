// The page: receives events and draws the panels. All data come from this server; none are sent to it.
import { Sky, isSeen, rmsNear } from "/sky.js";
import { Passes } from "/passes.js";
import { drawOrbit, drawPowers, drawUvw, tellOrbit } from "/array.js";
import { $, clock, copyText, css, dateOf, days, learnLeaps, make, nice, number, prefixed, short, stored, ticks, utc } from "/tools.js";
import { showVitals, waitingFor } from "/vitals.js";

const HELD_BYTES = 96e6, SAMPLE = 65536;
const BLINK_MS = 700, PLAY_MS = 450, KIOSK_MS = 1200, KIOSK_LAST = 5;
/** Maps of the newest data only. */
const OF_NEWEST = { noise: "noise alone", sigma: "standard deviation σ", mask: "mask", resolution: "resolution", hits: "visibilities by direction" };
const state = {
  status: null, config: null, kiosk: false, lasted: 0, channel: 0, number: null, follows: true, figures: new Map(), curve: "growth",
  maps: new Map(), blink: false, blinkOn: false, playing: false, gapsAt: 0, gapsSeen: 0,
  arrayAt: 0, arrayKnown: null, fetching: false, geometry: null, density: null, powers: null, noise: null,
};
let sky, passes;

const duration = (s) => {
  if (!(s > 0)) return "0";
  if (s >= 1) return `${s.toPrecision(3)} s`;
  if (s >= 1e-3) return `${(s * 1e3).toPrecision(3)} ms`;
  return `${(s * 1e6).toPrecision(3)} µs`;
};
const channelNow = () => state.status?.channels.find((c) => c.channel === state.channel);

// ---- Maps ----
async function fetchMap(name) {
  // The hits are not cached, as they grow with the data.
  if (name === "hits") {
    const found = await (await fetch(`/api/hits/${state.channel}`)).json();
    return found && Float32Array.from(found.hits);
  }
  const key = `${state.channel}/${name}`;
  const held = state.maps.get(key);
  if (held) { state.maps.delete(key); state.maps.set(key, held); return held; }
  const answer = await fetch(`/api/maps/${key}.f32`);
  if (!answer.ok) return null;
  const bytes = new DataView(await answer.arrayBuffer());
  const values = new Float32Array(bytes.byteLength / 4);
  for (let k = 0; k < values.length; k++) values[k] = bytes.getFloat32(4 * k, true);
  // Maps of the newest data change with each snapshot, so they are not cached.
  if (!OF_NEWEST[name]) state.maps.set(key, values);
  const bytesHeld = () => [...state.maps.values()].reduce((sum, map) => sum + map.byteLength, 0);
  while (state.maps.size > 2 && bytesHeld() > HELD_BYTES) state.maps.delete(state.maps.keys().next().value);
  return values;
}

/** Removes maps from the cache that the server no longer holds. */
function forgetMaps(channels) {
  const held = new Set(channels.flatMap(({ channel, held }) => ["input", ...held].map((name) => `${channel}/${name}`)));
  for (const key of state.maps.keys()) if (!held.has(key)) state.maps.delete(key);
}

let drawing = 0;
async function showSky() {
  const turn = ++drawing, channel = channelNow();
  if (!channel || !sky) return;
  const held = channel.held, at = Math.max(0, held.indexOf(state.number));
  const before = held[at - 1];
  let [first, second] = [String(state.number), null];
  const show = $("show").value;
  if (show === "difference") second = before === undefined ? null : String(before);
  if (show === "input") first = "input";
  if (show === "error") second = "input";
  if (OF_NEWEST[show]) first = show;
  const other = channel.has_input ? "input" : before === undefined ? null : String(before);
  if (state.blink && state.blinkOn && other) first = other;
  const [a, b] = await Promise.all([fetchMap(first), second === null ? null : fetchMap(second)]);
  if (turn !== drawing) return;
  if (!a || (second !== null && !b)) return; // The server has removed the map; the next status lists the maps that it holds.
  $("waiting").hidden = true;
  // Without a map before it there is no difference to show, but the map.
  sky.isDifference = b !== null;
  sky.show(a, b);
  const named = (name) => (name === "input" ? "input sky" : OF_NEWEST[name] ?? `map ${name}`);
  const blinks = state.blink ? (other ? ` · blinks with ${named(first === other ? String(state.number) : other)}, on one scale` : " · nothing to blink with yet") : "";
  const missing = show === "difference" && !second ? ", the first: no difference yet" : "";
  const newest = OF_NEWEST[show] && show !== "hits" ? ` of map ${held.at(-1)}` : "";
  // Two frames, and all frames of a sequence, have the scale of one.
  const common = state.blink && other ? other : state.kiosk || state.playing ? String(held.at(-1)) : null;
  limits((common && !OF_NEWEST[show] && !b && await fetchMap(common)) || a, b);
  if (turn !== drawing) return;
  $("shown").textContent = `${named(first)}${second ? ` − ${named(second)}` : ""}${newest}${missing}${blinks}`;
  draw();
}

const unit = () => ({ hits: "visibilities", mask: "", resolution: "°" })[$("show").value] ?? "K";
const quantile = (sorted, q) => sorted[Math.min(sorted.length - 1, Math.max(0, Math.round(q * (sorted.length - 1))))];
function limits(a, b) {
  const look = sky.look, show = $("show").value, isDifference = sky.isDifference, isNoise = show === "noise", isPlain = ["hits", "mask", "resolution"].includes(show);
  look.smooth = $("smooth").checked; look.marks = $("marks").checked;
  look.palette = isDifference || isNoise ? "difference" : isPlain ? "viridis" : $("palette").value;
  look.scale = isDifference || isNoise || isPlain ? "linear" : $("scale").value;
  if ($("fixed").checked) {
    const [low, high] = [Number($("from").value), Number($("to").value)];
    if (low < high && (look.scale !== "log" || low > 0)) { look.low = low; look.high = high; return; }
  }
  // Limits as in the program's pictures: from 0.5 % to 99.5 %, or symmetric; a mask is 0 or 1.
  if (show === "mask") { look.low = 0; look.high = 1; return; }
  // Quantiles of a large map are taken over a subset of its pixels.
  let used = [];
  for (let k = 0, step = Math.ceil(a.length / SAMPLE); k < a.length; k += step) used.push(b ? a[k] - b[k] : a[k]);
  used = used.filter(isSeen);
  if (isDifference || isNoise) {
    const sizes = Float64Array.from(used, Math.abs).sort();
    look.high = quantile(sizes, 0.99) || 1; look.low = -look.high;
  } else {
    if (look.scale === "log") used = used.filter((v) => v > 0);
    const sorted = Float64Array.from(used).sort();
    look.low = quantile(sorted, 0.005) ?? 1; look.high = quantile(sorted, 0.995) ?? 2;
    if (!(look.high > look.low * (1 + 1e-9))) { look.low = look.low / 1.2 - (look.scale === "log" ? 0 : 1); look.high = look.high * 1.2 + 1e-9; }
  }
  $("from").value = short(look.low); $("to").value = short(look.high);
}

function draw() {
  if (!sky) return;
  $("stage").classList.toggle("globe", sky.view.projection === "globe");
  sky.draw();
  const { look } = sky, colours = sky.palettes[look.palette], canvas = $("legend"), c = canvas.getContext("2d");
  canvas.width = 256; canvas.height = 1;
  const image = c.createImageData(256, 1);
  for (let k = 0; k < 256; k++) image.data.set([colours[3 * k], colours[3 * k + 1], colours[3 * k + 2], 255], 4 * k);
  c.putImageData(image, 0, 0);
  $("low").textContent = `${short(look.low)} ${unit()}`; $("high").textContent = `${short(look.high)} ${unit()}, ${look.scale}`; caption();
}

function chooseNumber(held, place) {
  state.number = held[place];
  state.follows = place === held.length - 1;
  syncSlider();
  showSky();
}

function syncSlider() {
  const channel = channelNow();
  if (!channel) return;
  const { held } = channel, slider = $("slider"), place = held.indexOf(state.number);
  slider.max = String(held.length - 1); slider.value = String(place);
  const snapshots = state.figures.get(state.channel)?.snapshots ?? [];
  const figures = snapshots.find((s) => s.number === state.number) ?? (place === held.length - 1 ? channel.figures : null);
  const isFinal = channel.is_final && place === held.length - 1;
  $("which").textContent = `${isFinal ? "final map" : `snapshot ${state.number}`}${figures ? `, until ${utc(channel.epoch_tai_s, figures.until_s)} UTC (day ${(figures.until_s / 86400).toFixed(1)})` : ""}`;
  caption();
  const file = `/api/maps/${state.channel}/${state.number}`;
  $("fits").href = `${file}.fits`; $("png").href = `${file}.png`;
  $("fits").download = `channel-${state.channel}-${state.number}.fits`;
}

// ---- Panels ----
function showChannels(channels) {
  const tabs = $("channels"), known = [...tabs.children].map((tab) => tab.dataset.channel).join();
  if (known !== channels.map((c) => String(c.channel)).join()) {
    tabs.replaceChildren(...channels.map((c, k) => {
      const tab = make("button", { role: "tab", title: `Channel ${c.channel} (${k + 1})` }, `${(c.frequency_hz / 1e6).toFixed(c.frequency_hz % 1e5 ? 3 : 1)} MHz`);
      tab.dataset.channel = c.channel;
      tab.addEventListener("click", () => chooseChannel(c.channel));
      return tab;
    }));
  }
  for (const tab of tabs.children) tab.setAttribute("aria-selected", String(Number(tab.dataset.channel) === state.channel));
}

function chooseChannel(channel) {
  state.channel = channel; state.number = null; state.follows = true;
  update(state.status);
}

function showStages(stages) {
  const list = $("stages");
  const names = stages.map((s) => s.name).join();
  if (list.dataset.names !== names) {
    list.dataset.names = names;
    list.replaceChildren(...stages.map((stage) => {
      const item = make("li");
      if (stage.queue) item.append(make("div", { class: "queue" }, make("div", { class: "tube" }, make("i")), make("span"), make("span", { "aria-hidden": "true" }, "→")));
      item.append(make("div", { class: "box" }, make("b", {}, stage.name), make("div", { class: "load" }, make("i")), make("span"), make("span"), make("span")));
      return item;
    }));
  }
  const running = stages.filter((s) => !s.ended);
  const busiest = running.reduce((most, s) => (s.busy > (most?.busy ?? 0.02) ? s : most), null);
  $("busiest").textContent = busiest ? `busiest: ${busiest.name}, ${(100 * busiest.busy).toFixed(0)} %` : "";
  stages.forEach((stage, k) => {
    const item = list.children[k], box = item.querySelector(".box"), [rate, step, latency] = box.querySelectorAll("span");
    box.classList.toggle("busiest", stage === busiest); box.classList.toggle("ended", stage.ended);
    box.querySelector(".load i").style.width = `${100 * stage.busy}%`;
    const unit = { visibilities: "vis", bytes: "B" }[stage.unit] ?? stage.unit;
    rate.textContent = stage.unit ? `${prefixed(stage.units_per_s)}${unit}/s` : `${number.format(stage.items_out)} items`;
    step.textContent = stage.working.count ? `step ${duration(stage.working.p99_s)}` : "no step yet";
    latency.textContent = stage.since_source.count ? `latency ${duration(stage.since_source.p99_s)}` : `${(100 * stage.busy).toFixed(0)} % busy`;
    box.title = `${stage.name}: ${number.format(stage.units)} ${stage.unit || "items"} so far, ${(100 * stage.busy).toFixed(0)} % busy; p99 of a step ${duration(stage.working.p99_s)}, p99 of the latency since the source ${duration(stage.since_source.p99_s)}${stage.ended ? "; ended" : ""}`;
    const queue = item.querySelector(".queue");
    if (queue) {
      const { depth, capacity, depth_max } = stage.queue;
      queue.querySelector("i").style.width = `${100 * depth / capacity}%`;
      queue.classList.toggle("full", depth >= capacity);
      queue.querySelector("span").textContent = `${depth} / ${capacity}`;
      queue.title = `input queue of ${stage.name}: ${depth} of ${capacity} items, at most ${depth_max} so far`;
    }
  });
}

function showSolver(solving) {
  $("solver").hidden = !solving;
  if (!solving) return;
  const done = Math.min(1, Math.max(0, Math.log(solving.residual) / Math.log(solving.target)));
  $("solved").style.width = `${100 * done}%`;
  const left = solving.left_s === null ? "" : `, about ${clock(solving.left_s)} left`;
  $("solving").textContent = `${solving.what}: iteration ${solving.iteration}, residual ${solving.residual.toExponential(1)} of ${solving.target.toExponential(0)}${left}`;
}

/** Numbers of the reasons' colours, which each keeps while the page is open. */
const reasons = [], REASON_COLOURS = 8;
const reasonOf = (name) => { if (!/^(flagged|lost)/.test(name)) return 0; if (!reasons.includes(name)) reasons.push(name); return reasons.indexOf(name) % REASON_COLOURS; };

function showLedger(ledger, phase) {
  const panel = document.querySelector(".ledger");
  panel.hidden = !ledger;
  if (!ledger) return;
  const sum = (counts) => counts.reduce((a, b) => a + b, 0);
  const flagged = Object.entries(ledger.flagged), lost = ledger.lost;
  const parts = [["accumulated", "accumulated", ledger.accumulated],
    ...flagged.map(([reason, count]) => ["flagged", `flagged: ${reason}`, count]),
    ...lost.map(({ stage, reason, count }) => ["lost", `lost in ${stage}: ${reason}`, count])];
  const isOver = phase === "ended" || phase === "failed";
  const rest = ledger.unaccounted;
  if (rest > 0) parts.push(["pending", isOver ? "unaccounted" : "on their way", rest]);
  const colour = (node, name) => { node.style.setProperty("--of", `var(--flag${reasonOf(name)})`); return node; };
  const total = Math.max(1, sum(parts.map(([, , count]) => count)));
  const bar = $("ledgerbar");
  bar.replaceChildren(...parts.filter(([, , count]) => count > 0).map(([kind, name, count]) => {
    const part = colour(make("i", { class: kind, title: `${name}: ${number.format(count)}` }), name);
    part.style.width = `${100 * count / total}%`;
    return part;
  }));
  const isKnown = isOver && rest !== null;
  const verdict = isKnown ? (rest === 0 ? ["good", "✔ balanced"] : ["bad", "✖ not balanced"]) : ["", isOver ? "balance unknown: the run failed" : "not final while running"];
  $("verdict").className = `verdict ${verdict[0]}`; $("verdict").textContent = verdict[1];
  bar.className = `ledgerbar ${isKnown ? (rest === 0 ? "closed" : "open") : ""}`;
  bar.setAttribute("aria-label", parts.map(([, name, count]) => `${name} ${count}`).join(", "));
  const rows = [["", "sampled", ledger.sampled ?? "known at the end"], ...parts];
  $("ledgerkeys").replaceChildren(...rows.map(([kind, name, count]) => make("li", {}, colour(make("i", { class: kind }), name), make("span", {}, name), make("b", {}, typeof count === "string" ? count : number.format(count)))));
}

function showReception(status) {
  const { reception, listening } = status;
  document.querySelector(".reception").hidden = !reception;
  if (!reception) return;
  const head = make("tr", {}, ...["packets", "received", "missing", "damaged", "duplicates"].map((name) => make("th", { scope: "col" }, name)));
  const kinds = ["instrument", "ephemeris", "visibilities", "housekeeping"];
  const cell = (count, isBad) => make("td", isBad && count > 0 ? { class: "bad" } : {}, number.format(count));
  $("packets").replaceChildren(head, ...kinds.map((kind) => {
    const k = reception[kind];
    return make("tr", {}, make("td", {}, kind), cell(k.packets), cell(k.missing, true), cell(k.damaged, true), cell(k.duplicates));
  }));
  const ends = listening ? Object.entries(listening.report.ended).map(([end, count]) => `${end} ${count}`).join(", ") : "";
  $("senders").textContent = listening ? `${listening.open} senders connected, ${number.format(listening.report.connections)} accepted, ${number.format(listening.report.refused)} refused; ${prefixed(listening.bytes)}B read, ${prefixed(listening.backlog_bytes)}B queued${ends ? `; ended: ${ends}` : ""}${listening.archive ? `; ${prefixed(listening.archive.bytes)}B in the raw archive` : ""}` : `${prefixed(reception.bytes)}B received`;
}

function showFigures() {
  const channel = channelNow();
  if (!channel) return;
  const figures = channel.figures, list = [];
  const add = (name, value) => list.push(make("div", {}, make("dt", {}, name), make("dd", {}, value)));
  add("visibilities", number.format(figures.visibilities)); add("data span", days(channel.span_s[1] - channel.span_s[0]));
  add("nside", String(channel.nside)); add("noise rms", `${short(channel.noise_rms_k)} K`);
  if (figures.rms_error_over_rms_truth !== undefined) add("rms error / rms sky", short(figures.rms_error_over_rms_truth));
  if (figures.rho_mean !== undefined) add("mean ρ, ℓ ≤ 2 nside", short(figures.rho_mean));
  const { epsilon } = channel.diagnostics;
  add(epsilon === undefined ? "regulariser" : "ε", epsilon === undefined ? "from the data" : short(epsilon));
  $("figures").replaceChildren(...list);
}

// ---- Curves ----
const COLOURS = ["--cool", "--hot", "--third", "--good"], DASHES = [[], [6, 4], [2, 3], [8, 3, 2, 3]];
function drawCurve() {
  const canvas = $("curve"), box = canvas.getBoundingClientRect(), ratio = Math.min(devicePixelRatio || 1, 2);
  if (!box.width) return;
  canvas.width = box.width * ratio; canvas.height = box.height * ratio;
  const c = canvas.getContext("2d");
  c.scale(ratio, ratio);
  const data = state.figures.get(state.channel), channel = channelNow();
  const { snapshots = [], spectra } = data ?? {};
  const byDegree = (values) => (values ?? []).map((v, l) => [l, v]).slice(1);
  const when = (key, of = (v) => v) => snapshots.filter((s) => s[key] !== undefined).map((s) => [s.until_s / 86400, of(s[key])]);
  const plots = {
    rho: { x: "degree ℓ", low: 0, high: 1.05, lines: [["map", byDegree(spectra?.rho)], ["its noise subtracted", byDegree(spectra?.rho_noise_subtracted)]] },
    cl: { x: "degree ℓ", y: "K²", log: true, lines: [["map", byDegree(spectra?.cl_map)], ["input", byDegree(spectra?.cl_truth)], ["noise floor", byDegree(spectra?.cl_noise)]] },
    // Without a truth, noise and sky together are told from noise alone.
    snr: { x: "degree ℓ", log: true, lines: [["SNR against the input", byDegree(spectra?.snr)],
      ["Cℓ of the map / Cℓ of its noise", spectra?.snr || !spectra?.cl_noise ? [] : byDegree(spectra.cl_map.map((v, l) => v / spectra.cl_noise[l]))]] },
    growth: { x: "UTC", low: 0, when: channel?.epoch_tai_s, lines: [["rms error / rms sky", when("rms_error_over_rms_truth")], ["mean ρ", when("rho_mean")]] },
  };
  const plot = plots[state.curve];
  if (state.curve === "growth" && plot.lines.every(([, points]) => points.length === 0)) {
    plot.lines = [["visibilities", when("visibilities")]]; plot.low = 0;
  }
  const lines = plot.lines.map(([name, points]) => [name, points.filter(([, v]) => v !== null && Number.isFinite(v) && (!plot.log || v > 0))]).filter(([, points]) => points.length);
  const all = lines.flatMap(([, points]) => points);
  c.font = "11px system-ui, sans-serif"; c.fillStyle = css("--quiet");
  if (!all.length) {
    c.textAlign = "center";
    const without = state.curve === "rho" ? "needs the input sky, which only a simulation has" : state.curve === "snr" && channel?.is_noiseless ? "the data are without noise" : "without the input sky, spectra are computed up to nside 64";
    c.fillText(channel ? without : "curves begin with the first map", box.width / 2, box.height / 2);
    return;
  }
  const t = plot.log ? Math.log10 : (v) => v;
  const least = (of) => all.reduce((a, p) => Math.min(a, of(p)), Infinity), most = (of) => all.reduce((a, p) => Math.max(a, of(p)), -Infinity);
  let [x0, x1, y0, y1] = [least((p) => p[0]), most((p) => p[0]), plot.low ?? least((p) => t(p[1])), plot.high ?? most((p) => t(p[1]))];
  if (x1 === x0) { x0 -= 1; x1 += 1; }
  if (y1 - y0 < 1e-9) y1 = y0 + 1;
  if (!plot.high && !plot.log) y1 *= 1.05;
  const [left, right, top, bottom] = [52, 10, 24, 30], [w, h] = [box.width - left - right, box.height - top - bottom];
  const px = (x) => left + (x - x0) / (x1 - x0) * w, py = (y) => top + h - (t(y) - y0) / (y1 - y0) * h;
  c.strokeStyle = css("--line"); c.lineWidth = 1;
  c.textAlign = "right"; c.textBaseline = "middle";
  for (const v of ticks(y0, y1, plot.log ? Math.max(1, Math.ceil((y1 - y0) / 5)) : nice(y1 - y0, 4))) {
    const y = top + h - (v - y0) / (y1 - y0) * h;
    c.beginPath(); c.moveTo(left, y); c.lineTo(left + w, y); c.stroke();
    c.fillText(plot.log ? `1e${v}` : short(v), left - 6, y);
  }
  c.textAlign = "center"; c.textBaseline = "alphabetic";
  const step = nice(x1 - x0, plot.when === undefined ? 5 : 3);
  for (const v of ticks(x0, x1, step)) {
    c.beginPath(); c.moveTo(px(v), top); c.lineTo(px(v), top + h); c.stroke();
    c.fillText(plot.when === undefined ? short(v) : utc(plot.when, v * 86400).slice(0, step < 1 ? 16 : 10), px(v), top + h + 14);
  }
  c.fillText(plot.x, left + w / 2, top + h + 27);
  if (plot.y) { c.textAlign = "left"; c.fillText(plot.y, 4, 12); }
  let at = left + 4;
  lines.forEach(([name, points], k) => {
    c.strokeStyle = c.fillStyle = css(COLOURS[k]); c.lineWidth = 2; c.setLineDash(DASHES[k]);
    c.beginPath(); points.forEach(([x, y], n) => (n ? c.lineTo(px(x), py(y)) : c.moveTo(px(x), py(y)))); c.stroke();
    c.beginPath(); c.moveTo(at, 12); c.lineTo(at + 22, 12); c.stroke(); c.setLineDash([]);
    if (points.length < 40) for (const [x, y] of points) { c.beginPath(); c.arc(px(x), py(y), 2.4, 0, 7); c.fill(); }
    c.fillStyle = css("--text"); c.textAlign = "left"; c.fillText(name, at + 27, 16);
    at += 45 + c.measureText(name).width;
  });
}

async function fetchFigures(channel) {
  const answer = await fetch(`/api/figures/${channel}`);
  if (!answer.ok) return;
  state.figures.set(channel, await answer.json());
  if (channel === state.channel) { drawCurve(); syncSlider(); }
}

// ---- Gaps ----
async function fetchGaps() {
  const answer = await fetch("/api/gaps");
  if (!answer.ok) { $("gapsnote").textContent = await answer.text(); return; }
  const { gaps, restarts } = await answer.json();
  const rows = gaps.slice(0, 50);
  const head = make("tr", {}, ...["APID", "from", "to", "lost, h", "gain, %"].map((name) => make("th", { scope: "col" }, name)));
  $("gaps").replaceChildren(head, ...rows.map((gap) => make("tr", {}, make("td", {}, `0x${gap.apid.toString(16)}`), make("td", {}, String(gap.from)), make("td", {}, String(gap.to)), make("td", {}, short(gap.integration_s / 3600)), make("td", {}, short(100 * gap.gain)))));
  $("gaps").hidden = rows.length === 0;
  $("gapsnote").textContent = (gaps.length ? `${gaps.length} gaps, most valuable first, as of the last checkpoint` : "No packets are missing between those received, as of the last checkpoint.") + (restarts?.length ? `; ${restarts.length} restarts of the counts` : "");
  $("copy").onclick = () => copyText(gaps.map((gap) => `0x${gap.apid.toString(16)} ${gap.from} ${gap.to}`).join("\n"));
}

// ---- Passes, orbit, baselines ----
const LOOK_MS = 1500;
async function fetchOf(path) {
  const answer = await fetch(path);
  return answer.ok ? answer.json() : null;
}

/** Fetches passes, geometry, baselines and powers if new data have arrived; at most every LOOK_MS, one request set at a time. */
async function fetchArray(status) {
  const known = `${status.phase}/${status.reception.bytes}/${state.channel}`;
  if (document.hidden || state.fetching || known === state.arrayKnown || Date.now() - state.arrayAt < LOOK_MS) return;
  state.fetching = true;
  try {
    const paths = ["/api/passes", "/api/geometry", `/api/uvw/${state.channel}`, `/api/powers/${state.channel}`];
    const [line, geometry, density, powers] = await Promise.all(paths.map(fetchOf));
    Object.assign(state, { geometry, density, powers, arrayKnown: known });
    passes.show(line);
    drawArray();
  } catch { /* Cut; the next status asks again. */ }
  state.arrayAt = Date.now(); state.fetching = false;
}

function drawArray() {
  $("noorbit").hidden = !!state.geometry; $("nouvw").hidden = !!state.density;
  drawOrbit($("orbit"), state.geometry, $("orbitview").value); tellOrbit(state.geometry);
  $("powersbox").hidden = !state.powers;
  if (!sky) return;
  const colours = sky.palettes[$("palette").value];
  drawUvw($("uvw"), state.density, colours); drawPowers($("powers"), state.powers, colours, state.geometry?.epoch_tai_s ?? NaN);
}

function redraw() { draw(); drawCurve(); passes.draw(); drawArray(); }

// ---- Status ----
function update(status) {
  if (!status) return;
  state.status = status;
  $("name").textContent = `${status.name ? `· ${status.name} ` : ""}· ${({ whole: "whole chain", ground: "ground", space: "space segment" })[status.segment] ?? status.segment}`;
  document.title = `${status.name || "lunarray"} – ${status.phase}`;
  const phase = $("phase");
  phase.textContent = status.phase === "ended" && status.cancelled ? "ended early" : status.phase; phase.className = `chip ${status.phase}`;
  phase.title = status.error ?? "";
  $("elapsed").textContent = `for ${clock(status.elapsed_s)}`;
  showStages(status.stages); showSolver(status.solving); showLedger(status.ledger, status.phase); showReception(status);
  showChannels(status.channels);
  $("gapspanel").hidden = !status.has_state;
  const saved = status.saving?.written ?? 0;
  if (status.has_state && saved !== state.gapsSeen && Date.now() - state.gapsAt > 5000) {
    state.gapsAt = Date.now(); state.gapsSeen = saved; fetchGaps();
  }
  if (status.reception) fetchArray(status);
  const sections = document.querySelectorAll(".sky, .quality, .passes, .orbit, .uvw");
  for (const section of sections) section.hidden = status.segment === "space";
  const channel = channelNow() ?? status.channels[0];
  if (!channel) { $("waiting").textContent = waitingFor(status, state.config); return; }
  state.channel = channel.channel;
  const has = { input: channel.has_input, error: channel.has_input, sigma: channel.has_errors, mask: channel.has_errors, resolution: channel.has_errors };
  for (const option of $("show").options) option.hidden = option.disabled = has[option.value] === false;
  if ($("show").selectedOptions[0].disabled) choose("map");
  const latest = channel.held.at(-1), isNew = !channel.held.includes(state.number);
  const news = `${channel.channel}/${latest}/${channel.is_final}`;
  if (state.follows || isNew) {
    const changed = state.number !== latest;
    state.number = latest;
    if (changed) showSky();
  }
  if (state.news !== news) { state.news = news; forgetMaps(status.channels); fetchFigures(channel.channel); showFigures(); drawCurve(); }
  syncSlider();
}

/** Shows whether the page is connected, the age of its data if not, and whether another run has started. */
function stale(is) {
  document.body.classList.toggle("stale", is);
  const began = state.began ? ` · another run since ${dateOf(state.began)} UTC` : "";
  const age = state.heardAt ? clock((Date.now() - state.heardAt) / 1000) : null;
  $("link").textContent = is ? `▲ not connected: ${age === null ? "nothing is known" : `what is shown is ${age} old`}` : `● live${began}`;
}

/** Seconds since 1970 by the server's clock. */
const now = () => state.status.unix_s + (Date.now() - state.heardAt) / 1000;
function tick() {
  if (document.body.classList.contains("stale")) stale(true);
  if (!state.status) return;
  $("utc").textContent = `${dateOf(now())} UTC`;
  showVitals(state.status, state.geometry, state.heardAt);
  caption();
}


function listen() {
  const source = new EventSource("/events");
  source.addEventListener("open", () => { stale(false); });
  source.addEventListener("error", () => stale(true));
  setInterval(tick, 1000);
  source.addEventListener("status", (event) => {
    const status = JSON.parse(event.data);
    // Another run has started: cached data are of the old one.
    if (state.status && status.up_s < state.status.up_s - 1) {
      state.began = status.unix_s - status.up_s;
      state.maps.clear(); state.figures.clear(); state.number = null; state.news = null; state.arrayKnown = null; $("log").replaceChildren();
    }
    state.heardAt = Date.now();
    stale(false);
    update(status);
    tick();
  });
  source.addEventListener("log", (event) => {
    const entry = JSON.parse(event.data), log = $("log");
    if ([...log.children].some((item) => item.dataset.id === String(entry.id))) return;
    const item = make("li", {}, make("time", { title: `${dateOf(entry.unix_s)} UTC` }, dateOf(entry.unix_s).slice(5)), make("span", entry.is_bad ? { class: "bad" } : {}, entry.text));
    item.dataset.id = entry.id;
    log.prepend(item);
    while (log.children.length > 256) log.lastChild.remove();
  });
}

// Number of pixels around the cursor for the rms of the noise-only map, which is then known to 7 %.
const NEAR_PIXELS = 100;
/** Text on the noise near a direction. It is estimated from the noise-only map of the newest snapshot. */
function noiseOfMap(direction) {
  const channel = channelNow(), isMap = $("show").value === "map" && !state.blink;
  if (!isMap || !channel || channel.is_noiseless || state.number !== channel.held.at(-1)) return "";
  const whole = `of the whole map ${short(channel.noise_rms_k)} K`, key = `${state.channel}/${state.number}`;
  if (state.noise?.key !== key) {
    // The map is used at a later move of the cursor.
    state.noise = { key, values: null };
    fetchMap("noise").then((values) => { if (state.noise.key === key) state.noise.values = values; });
  }
  if (!state.noise.values) return ` (noise rms ${whole})`;
  const { rms, radius } = rmsNear(state.noise.values, direction, NEAR_PIXELS);
  return ` (± ${short(rms)} K, noise rms within ${radius.toPrecision(2)}°; ${whole})`;
}

// ---- Controls ----
function setView(change) {
  Object.assign(sky.view, change);
  for (const key of ["projection", "frame"]) { $(key).value = sky.view[key]; stored(key, sky.view[key]); }
  sky.view.lon = ((sky.view.lon % 360) + 360) % 360; sky.view.lat = Math.max(-90, Math.min(90, sky.view.lat));
  draw();
}
function press(button, on) { button.setAttribute("aria-pressed", String(on)); }
function play(on) { state.playing = on; press($("play"), on); $("play").textContent = on ? "❚❚" : "▶"; if (on) { const held = channelNow()?.held; if (held && state.number === held.at(-1)) chooseNumber(held, 0); } }
function blink(on) { if (on) $("show").value = "map"; state.blink = on; state.blinkOn = false; press($("blink"), on); showSky(); }
function choose(show) { $("show").value = show; if (state.blink) blink(false); else showSky(); }

/** Fills the window, or the screen, with the sky, which plays from the first map to the newest, channel after channel. */
function kiosk(on) {
  if (on) choose("map");
  state.kiosk = on; state.lasted = 0; play(false);
  document.body.classList.toggle("kiosk", on);
  // Browsers refuse the screen without a gesture; it then fills the window.
  if (on && navigator.userActivation?.isActive) document.documentElement.requestFullscreen?.().catch(() => {});
  if (!on && document.fullscreenElement) document.exitFullscreen();
  const held = channelNow()?.held;
  if (held) chooseNumber(held, on ? 0 : held.length - 1);
  redraw();
}
function kioskStep() {
  const channels = state.status?.channels ?? [], held = channelNow()?.held ?? [], at = held.indexOf(state.number);
  if (!state.kiosk || document.hidden || !held.length) return;
  if (at < held.length - 1) return chooseNumber(held, at + 1);
  if (++state.lasted < KIOSK_LAST) return;
  state.lasted = 0;
  const next = channels[(channels.findIndex((c) => c.channel === state.channel) + 1) % channels.length];
  chooseChannel(next.channel); chooseNumber(next.held, 0);
}
/** What the kiosk shows, and how old it is. */
function caption() {
  const { status } = state, channel = channelNow();
  if (!state.kiosk || !status) return;
  const what = channel ? `${channel.frequency_hz / 1e6} MHz · ${$("which").textContent}` : "";
  $("caption").replaceChildren(make("b", {}, status.name), make("span", {}, what), make("span", {}, `${status.phase} · ${$("utc").textContent} · ${$("link").textContent}`));
}
function step(by) { const held = channelNow()?.held; if (held) chooseNumber(held, Math.min(held.length - 1, Math.max(0, held.indexOf(state.number) + by))); }
function cycle(select) { const options = [...select.options].filter((o) => !o.disabled); select.value = options[(options.findIndex((o) => o.value === select.value) + 1) % options.length].value; select.dispatchEvent(new Event("change")); }
function theme(name) { document.documentElement.dataset.theme = name; stored("theme", name); redraw(); }

function controls() {
  setInterval(() => { if (state.playing) { const held = channelNow()?.held ?? [], at = held.indexOf(state.number); if (at < 0 || at >= held.length - 1) play(false); else chooseNumber(held, at + 1); } }, PLAY_MS);
  setInterval(kioskStep, KIOSK_MS);
  setInterval(() => { if (state.blink && !document.hidden) { state.blinkOn = !state.blinkOn; showSky(); } }, BLINK_MS);
  $("play").addEventListener("click", () => play(!state.playing));
  $("blink").addEventListener("click", () => blink(!state.blink));
  $("slider").addEventListener("input", () => { play(false); chooseNumber(channelNow()?.held ?? [], Number($("slider").value)); });
  $("show").addEventListener("change", () => choose($("show").value));
  for (const id of ["scale", "palette", "smooth", "marks", "from", "to"]) $(id).addEventListener("change", () => { if (["scale", "palette"].includes(id)) stored(id, $(id).value); if (id === "palette") drawArray(); showSky(); });
  $("fixed").addEventListener("change", () => { for (const id of ["from", "to"]) $(id).disabled = !$("fixed").checked; showSky(); });
  for (const id of ["projection", "frame"]) $(id).addEventListener("change", () => setView({ [id]: $(id).value }));
  for (const tab of $("curves").children) tab.addEventListener("click", () => { state.curve = tab.dataset.curve; for (const other of $("curves").children) other.setAttribute("aria-selected", String(other === tab)); drawCurve(); });
  $("theme").addEventListener("click", () => theme(document.documentElement.dataset.theme === "dark" ? "light" : "dark"));
  $("kiosk").addEventListener("click", () => kiosk(true));
  addEventListener("fullscreenchange", () => { if (state.kiosk && !document.fullscreenElement) kiosk(false); });
  $("help").addEventListener("click", () => $("keys").showModal());
  const stage = $("stage");
  let drag = null;
  stage.addEventListener("pointerdown", (event) => { drag = { x: event.clientX, y: event.clientY, lon: sky.view.lon, lat: sky.view.lat }; stage.setPointerCapture(event.pointerId); });
  stage.addEventListener("pointerup", () => { drag = null; }); stage.addEventListener("pointercancel", () => { drag = null; });
  stage.addEventListener("pointermove", (event) => {
    if (drag) {
      const per = (sky.view.projection === "globe" ? 90 : 180) * sky.ratio / sky.half()[0];
      setView({ lon: drag.lon + (event.clientX - drag.x) * per, lat: drag.lat + (event.clientY - drag.y) * per });
      return;
    }
    const at = sky.probe(event.clientX, event.clientY), axes = { galactic: ["l", "b"], ecliptic: ["λ", "β"], equatorial: ["α", "δ"] }[sky.view.frame];
    $("cursor").textContent = at ? `${isSeen(at.value) ? `${short(at.value)} ${unit()}` : "not measured"}${noiseOfMap(at.direction)} · ${axes[0]} ${at.lon.toFixed(1)}° ${axes[1]} ${at.lat.toFixed(1)}° · pixel ${at.pixel}` : "";
  });
  stage.addEventListener("pointerleave", () => { $("cursor").textContent = ""; });
  addEventListener("resize", redraw);
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || $("keys").open) return;
    if (event.target.matches("input[type=number], select") || (event.target.matches("button, input[type=checkbox]") && event.key === " ")) return;
    const turns = { ArrowLeft: { lon: sky.view.lon - 10 }, ArrowRight: { lon: sky.view.lon + 10 }, ArrowUp: { lat: sky.view.lat + 10 }, ArrowDown: { lat: sky.view.lat - 10 } };
    const keys = {
      ArrowLeft: () => step(-1), ArrowRight: () => step(1), " ": () => play(!state.playing), "0": () => setView({ lon: 0, lat: 0 }),
      p: () => cycle($("projection")), f: () => cycle($("frame")), s: () => cycle($("scale")), c: () => cycle($("palette")),
      d: () => choose($("show").value === "difference" ? "map" : "difference"),
      b: () => blink(!state.blink), k: () => kiosk(!state.kiosk), Escape: () => state.kiosk && kiosk(false), t: () => $("theme").click(), "?": () => $("keys").showModal(),
    };
    if (event.shiftKey && turns[event.key]) setView(turns[event.key]);
    else if (/^[1-9]$/.test(event.key)) { const channel = state.status?.channels[Number(event.key) - 1]; if (channel) chooseChannel(channel.channel); }
    else if (keys[event.key]) keys[event.key]();
    else return;
    event.preventDefault();
  });
}

async function begin() {
  document.documentElement.dataset.theme = stored("theme") ?? (matchMedia("(prefers-color-scheme: light)").matches ? "light" : "dark");
  const constants = await (await fetch("/page.json")).json();
  learnLeaps(constants.leap_seconds);
  sky = new Sky($("gl"), $("over"), constants);
  for (const id of ["scale", "palette"]) { const value = stored(id); if (value && [...$(id).options].some((o) => o.value === value)) $(id).value = value; }
  for (const id of ["projection", "frame"]) { const value = stored(id); if (value && [...$(id).options].some((o) => o.value === value)) $(id).value = sky.view[id] = value; }
  passes = new Passes($("passes"));
  $("orbitview").value = stored("orbit") ?? "plane";
  $("orbitview").addEventListener("change", () => { stored("orbit", $("orbitview").value); drawArray(); });
  controls();
  drawCurve();
  listen();
  if (location.hash === "#kiosk") kiosk(true);
  state.config = await fetchOf("/api/config");
}
begin();
