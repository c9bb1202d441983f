// Functions shared by the scripts of the page.

export const $ = (id) => document.getElementById(id);

export const number = new Intl.NumberFormat("en", { maximumFractionDigits: 0 });
export const short = (v) => {
  if (v === null || v === undefined || !Number.isFinite(v)) return "–";
  const a = Math.abs(v);
  if (a !== 0 && (a >= 1e5 || a < 1e-2)) return v.toExponential(3).replace("e+", "e");
  return String(Number(v.toPrecision(a >= 1e4 ? 5 : 4)));
};
export const prefixed = (v) => {
  for (const [size, name] of [[1e9, " G"], [1e6, " M"], [1e3, " k"]]) if (v >= size) return (v / size).toPrecision(3) + name;
  return v === 0 ? "0 " : v >= 100 ? v.toFixed(0) + " " : v.toPrecision(3) + " ";
};
/** Hours, minutes and seconds. */
export const clock = (s) => {
  const [h, m, r] = [Math.floor(s / 3600), Math.floor(s / 60) % 60, Math.floor(s) % 60];
  return (h ? `${h}:` : "") + `${String(m).padStart(h ? 2 : 1, "0")}:${String(r).padStart(2, "0")}`;
};
/** An age. */
export const ago = (s) => `${s < 60 ? `${Math.floor(s)} s` : s < 86400 ? clock(s) : days(s)} ago`;
export const days = (s) => `${(s / 86400).toFixed(1)} d`;
/** Date and time, UTC, of seconds since 1970. */
export const dateOf = (unixS) => { const date = new Date(unixS * 1000); return Number.isNaN(date.getTime()) ? "–" : date.toISOString().slice(0, 19).replace("T", " "); };

export const make = (tag, attributes = {}, ...children) => {
  const node = document.createElement(tag);
  for (const [key, value] of Object.entries(attributes)) key === "class" ? (node.className = value) : node.setAttribute(key, value);
  node.append(...children);
  return node;
};
export const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
export const stored = (key, value) => {
  try { if (value !== undefined) localStorage.setItem(`lunarray.${key}`, value); return localStorage.getItem(`lunarray.${key}`); } catch { return null; }
};

/** A step of 1, 2 or 5 times a power of ten that divides a span into about `wanted` parts. */
export const nice = (span, wanted) => { const raw = span / wanted, p = 10 ** Math.floor(Math.log10(raw)); return p * ([1, 2, 5, 10].find((m) => m * p >= raw) ?? 10); };
export const ticks = (from, to, step) => { const found = []; for (let v = Math.ceil(from / step - 1e-9) * step; v <= to + 1e-9 * step; v += step) found.push(Math.abs(v) < 1e-12 * step ? 0 : v); return found; };

/** Prepares a canvas for drawing in CSS pixels; undefined while it is hidden. */
export function brush(canvas) {
  const box = canvas.getBoundingClientRect(), ratio = Math.min(devicePixelRatio || 1, 2);
  if (!box.width) return undefined;
  canvas.width = Math.round(box.width * ratio); canvas.height = Math.round(box.height * ratio);
  const c = canvas.getContext("2d");
  c.scale(ratio, ratio);
  c.font = "11px system-ui, sans-serif";
  return { c, width: box.width, height: box.height, ratio };
}

/** Copies a text; also without access to the clipboard, which browsers refuse to remote pages without encryption. */
export async function copyText(text) {
  if (navigator.clipboard) { try { await navigator.clipboard.writeText(text); return true; } catch { /* Falls through to the old method. */ } }
  const area = make("textarea", { readonly: "" });
  area.value = text;
  document.body.append(area);
  area.select();
  const done = document.execCommand("copy");
  area.remove();
  return done;
}

// The epoch of a mission is in TAI seconds since 1958. Leap seconds are rows of start (TAI since 1970, s) and TAI minus UTC (s).
const TO_1970_S = 4383 * 86400;
let leaps = [];
export const learnLeaps = (rows) => { leaps = rows; };
/** Date and time, UTC, of a mission time. */
export const utc = (epochTaiS, timeS) => {
  const tai = epochTaiS + timeS - TO_1970_S;
  return dateOf(tai - leaps.reduce((behind, [from, s]) => (from <= tai ? s : behind), 10)).slice(0, 16);
};
