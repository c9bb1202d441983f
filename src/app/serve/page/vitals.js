// What stands above all else: ages, stations and problems, and what an empty sky waits for.
import { $, ago, clock, days, make, number, prefixed, utc } from "/tools.js";

const RATE_MS = 5000;
/** Bytes of each station at earlier times, for rates. */
const read = new Map();

/** Bytes per second that came from a station over the last five seconds; undefined before there are two counts. */
function rateOf(name, bytes, now) {
  const counts = read.get(name) ?? [];
  if (counts.length && bytes < counts.at(-1)[1]) counts.length = 0;
  if (counts.at(-1)?.[0] !== now) counts.push([now, bytes]);
  while (counts.length > 2 && now - counts[1][0] >= RATE_MS) counts.shift();
  read.set(name, counts);
  const [from, since] = counts[0];
  return now > from ? 1000 * (bytes - since) / (now - from) : undefined;
}

/** Cards as [kind, name, texts, title]; `past`: seconds since the status came. */
function cardsOf(status, geometry, past, heardAt) {
  const { channels, listening, products, reception, saving } = status, archive = listening?.archive, cards = [];
  const bad = (name, text) => cards.push(["bad", `▲ ${name}`, [text], text]);
  if (status.error) bad("failed", status.error);
  if (archive?.unwritten) bad("no data are acknowledged", `the raw archive cannot be written: ${archive.unwritten}`);
  if (saving?.unsaved) bad("state not saved", `${saving.failed} attempt${saving.failed === 1 ? "" : "s"} failed: ${saving.unsaved}`);
  if (products?.unwritten) bad("maps are not written", products.unwritten);
  if (geometry) cards.push(["", "newest data", [`${utc(geometry.epoch_tai_s, geometry.time_s)} UTC`], "Time at which the newest visibilities were taken"]);
  if (channels.length) {
    const newest = channels.reduce((a, b) => (b.age_s < a.age_s ? b : a));
    cards.push(["", "newest map", [ago(newest.age_s + past), `${newest.frequency_hz / 1e6} MHz`], "Age of the newest map of any channel"]);
  }
  if (listening) cards.push([listening.silence_s === null ? "warn" : "", "last packet", [listening.silence_s === null ? "none yet" : ago(listening.silence_s + past)], "From any sender"]);
  if (saving) {
    const unsaved = saving.unsaved_bytes ? `${prefixed(saving.unsaved_bytes)}B not saved yet` : "";
    cards.push(["", "last checkpoint", [saving.checkpoint_s === undefined ? "none in this session" : ago(saving.checkpoint_s + past), unsaved], `${number.format(saving.written)} checkpoints written in this session`]);
  }
  if (reception) {
    const sum = (key) => ["instrument", "ephemeris", "visibilities", "housekeeping"].reduce((all, kind) => all + reception[kind][key], 0);
    const [missing, damaged] = [sum("missing"), sum("damaged")];
    cards.push([missing || damaged ? "warn" : "", "packets", [`${number.format(missing)} missing`, `${number.format(damaged)} damaged`], "Of all kinds"]);
  }
  for (const [name, of] of Object.entries(listening?.report.stations ?? {})) {
    const silence = listening.station_silence_s[name], rate = rateOf(name, of.bytes, heardAt);
    const counted = (count, one, many) => (count ? [`${number.format(count)} ${count === 1 ? one : many}`] : []);
    const errors = [...counted(of.faults, "fault", "faults"), ...counted(of.broken, "broken connection", "broken connections")];
    cards.push([silence === null || errors.length ? "warn" : "", name,
      [silence === null ? "not heard yet" : `heard ${ago(silence + past)}`, rate === undefined ? `${prefixed(of.bytes)}B` : `${prefixed(rate)}B/s`, errors.join(", ") || "no errors"],
      `Station ${name}: ${number.format(of.bytes)} bytes; faults are damaged packets, bytes of no packet, uncorrectable frames and losses of synchronisation`]);
  }
  return cards;
}

export function showVitals(status, geometry, heardAt) {
  const cards = cardsOf(status, geometry, (Date.now() - heardAt) / 1000, heardAt), list = $("vitals");
  // Cards stay in place, so that what is selected or read aloud does.
  while (list.children.length > cards.length) list.lastChild.remove();
  cards.forEach(([kind, name, texts, title], k) => {
    const card = list.children[k] ?? list.appendChild(make("li", {}, make("b"), make("span")));
    card.className = kind; card.title = title;
    const said = texts.filter(Boolean).join(" · ");
    if (card.firstChild.textContent !== name) card.firstChild.textContent = name;
    if (card.lastChild.textContent !== said) card.lastChild.textContent = said;
  });
}

/** What has to happen before there is a first map. */
export function waitingFor(status, config) {
  const { ledger, listening, phase, reception, solving } = status;
  if (phase === "failed") return `The run failed before its first map: ${status.error}`;
  if (phase === "ended") return "The run ended without a map.";
  if (phase === "starting" || !reception) return "The run is being prepared.";
  if (listening && listening.silence_s === null) return `Waits for the first packet at ${listening.report.address}; ${listening.open === 1 ? "1 sender is" : `${number.format(listening.open)} senders are`} connected.`;
  if (!reception.instrument.packets) return "Waits for the description of the instrument, a packet without which no other can be read.";
  if (!reception.ephemeris.packets) return "Waits for the daughters' positions.";
  if (solving) return `The first map is being solved: ${solving.what}, iteration ${number.format(solving.iteration)}.`;
  const every = config?.map.snapshot_every_s, summed = `${number.format(ledger?.accumulated ?? 0)} visibilities are in the sums.`;
  return `${summed} ${every > 0 ? `A map is made every ${days(every)} of mission time.` : "Maps are made at the end of the data."}`;
}
