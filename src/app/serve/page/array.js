// The array in its orbit at the time of the latest data, the density of its baselines in u, v, w, and the auto-correlations.
import { $, brush, css, number, short, utc } from "/tools.js";

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const scaled = (s, a) => a.map((v) => s * v);
const minus = (a, b) => a.map((v, k) => v - b[k]);
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const length = (a) => Math.sqrt(dot(a, a));
const unit = (a) => scaled(1 / (length(a) || 1), a);
/** Unit vector of the component of `a` perpendicular to `n`; any perpendicular direction if it is zero. */
const across = (a, n) => { const rest = minus(a, scaled(dot(a, n), n)); return length(rest) > 1e-6 ? unit(rest) : unit(cross(n, Math.abs(n[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0])); };

/** Axes of the picture: right, up, and towards the viewer. */
export function axesOf(view, { normal_hat, earth_hat }) {
  if (view === "earth" && earth_hat) { const up = across([0, 0, 1], earth_hat); return [cross(up, earth_hat), up, earth_hat]; }
  if (view === "pole") return [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  const right = across(earth_hat ?? [1, 0, 0], normal_hat);
  return [right, cross(normal_hat, right), normal_hat];
}

/** Whether the Moon occults direction `n` at position `r`. */
const isHidden = (r, n, radius) => -dot(n, r) > Math.sqrt(Math.max(0, dot(r, r) - radius * radius));

const RULER = 44;
/** Projection of positions to CSS pixels of the canvas; the Moon is in the centre above the ruler. */
export function frameOf(view, geometry, width, height) {
  const axes = axesOf(view, geometry), reach = Math.max(...[...geometry.orbit_m, ...geometry.track_m].map(length));
  const per = 0.44 * Math.min(width, height - RULER) / reach, middle = [width / 2, (height - RULER) / 2];
  return { axes, per, middle, put: (r) => [middle[0] + per * dot(r, axes[0]), middle[1] - per * dot(r, axes[1])], depth: (r) => dot(r, axes[2]) };
}

export function drawOrbit(canvas, geometry, view) {
  const at = brush(canvas);
  if (!at || !geometry) return;
  const { c, width, height } = at, { earth_hat: earth, moon_radius_m: radius, satellites, orbit_m: orbit, track_m: track } = geometry;
  const { axes, per, middle, put, depth } = frameOf(view, geometry, width, height), r = per * radius;
  const behind = (p) => depth(p) < 0 && Math.hypot(dot(p, axes[0]), dot(p, axes[1])) < radius;
  const side = earth && [dot(earth, axes[0]), dot(earth, axes[1])], flat = earth ? Math.hypot(...side) : 0;
  const turn = earth && flat > 0.05 ? Math.atan2(-side[1], side[0]) : null;
  if (turn !== null) {
    // The region in which the Earth is occulted.
    c.save(); c.beginPath(); c.rect(0, 0, width, height - RULER); c.clip(); c.translate(...middle); c.rotate(turn);
    c.fillStyle = css("--track"); c.fillRect(-2 * (width + height), -r, 2 * (width + height), 2 * r);
    c.restore();
  }
  // The orbit: wide where the Earth is occulted, left out behind the Moon.
  const stroke = (points, closes) => points.forEach((p, k) => {
    const next = points[k + 1] ?? (closes ? points[0] : null);
    if (!next || behind(p) || behind(next)) return;
    const hidden = earth && isHidden(p, earth, radius);
    c.strokeStyle = css(hidden ? "--hot" : "--quiet"); c.lineWidth = hidden ? 3 : 1.5;
    c.beginPath(); c.moveTo(...put(p)); c.lineTo(...put(next)); c.stroke();
  });
  stroke(orbit.length ? orbit : track, orbit.length > 0);
  // The Moon; its side away from the Earth is dark.
  c.save(); c.translate(...middle);
  c.fillStyle = css("--moon"); c.beginPath(); c.arc(0, 0, r, 0, 7); c.fill();
  if (earth) {
    const towards = dot(earth, axes[2]);
    c.rotate(turn ?? 0); c.fillStyle = css("--far"); c.beginPath();
    if (turn !== null) { c.arc(0, 0, r, Math.PI / 2, 3 * Math.PI / 2); c.ellipse(0, 0, Math.abs(towards) * r, r, 0, 3 * Math.PI / 2, Math.PI / 2, towards > 0); }
    else if (towards < 0) c.arc(0, 0, r, 0, 7);
    c.fill();
  }
  c.restore();
  c.font = "12px system-ui, sans-serif"; c.textBaseline = "middle"; c.fillStyle = css("--text");
  if (turn !== null) {
    const edge = Math.min((width / 2 - 8) / Math.abs(Math.cos(turn)), (height - RULER) / 2 / Math.abs(Math.sin(turn))), [x, y] = [middle[0] + edge * Math.cos(turn), middle[1] + edge * Math.sin(turn)];
    c.strokeStyle = css("--good"); c.fillStyle = css("--good"); c.lineWidth = 1.5;
    c.beginPath(); c.moveTo(middle[0] + (r + 6) * Math.cos(turn), middle[1] + (r + 6) * Math.sin(turn)); c.lineTo(x, y); c.stroke();
    c.save(); c.translate(x, y); c.rotate(turn); c.beginPath(); c.moveTo(0, 0); c.lineTo(-9, -5); c.lineTo(-9, 5); c.fill(); c.restore();
    // The label is beside a steep arrow and above a flat one.
    const isSteep = Math.abs(Math.sin(turn)) > 0.5;
    c.textAlign = isSteep || Math.cos(turn) < 0 ? "left" : "right";
    c.fillText("Earth", x + (isSteep ? 12 : 0), Math.max(10, y - 12));
  }
  // Satellites, which nearly coincide on this scale; those behind the Moon are rings.
  satellites.forEach(({ position_m: p }) => {
    c.fillStyle = c.strokeStyle = css("--cool"); c.lineWidth = 1.5;
    c.beginPath(); c.arc(...put(p), 4, 0, 7);
    behind(p) ? c.stroke() : c.fill();
  });
  drawRuler(c, width, height, satellites.map(({ position_m }) => position_m));
}

/** Draws distances from satellite 1 on a logarithmic scale, as the satellites are too close together to resolve in the orbit. */
function drawRuler(c, width, height, positions) {
  const apart = positions.slice(1).map((p) => length(minus(p, positions[0])) / 1e3).filter((d) => d > 0);
  if (!apart.length) return;
  const low = Math.floor(Math.log10(Math.min(...apart))), high = Math.max(low + 1, Math.ceil(Math.log10(Math.max(...apart))));
  const x = (km) => 40 + (Math.log10(km) - low) / (high - low) * (width - 80), y = height - 20;
  c.strokeStyle = css("--line"); c.fillStyle = css("--quiet"); c.lineWidth = 1; c.textAlign = "center"; c.font = "11px system-ui, sans-serif";
  c.beginPath(); c.moveTo(x(10 ** low), y); c.lineTo(x(10 ** high), y); c.stroke();
  for (let power = low; power <= high; power++) { c.fillRect(x(10 ** power), y - 3, 1, 7); c.fillText(`${short(10 ** power)} km`, x(10 ** power), y + 13); }
  c.fillStyle = css("--cool");
  for (const km of apart) { c.beginPath(); c.arc(x(km), y, 3.5, 0, 7); c.fill(); }
}

export function tellOrbit(geometry) {
  if (!geometry) return;
  const { time_s, epoch_tai_s, satellites, earth_hat, moon_radius_m } = geometry;
  const hidden = satellites.filter((s) => s.earth_is_hidden).length, count = satellites.length;
  const sight = !earth_hat ? "the configuration does not say where the Earth is" : hidden === count ? `Earth hidden from all ${count}` : `Earth hidden from ${hidden} of ${count}`;
  const high = (length(satellites[0].position_m) - moon_radius_m) / 1e3;
  $("orbittext").textContent = `Latest data: ${utc(epoch_tai_s, time_s)} UTC (day ${(time_s / 86400).toFixed(2)}). ${sight}; ${high.toFixed(0)} km above the mean surface. Below: distances from daughter 1.`;
}

/** Counts of a plane, including the baselines of opposite sign. */
export const bothSigns = (plane) => plane.map((count, k) => count + plane[plane.length - 1 - k]);

export function drawUvw(canvas, density, colours) {
  const at = brush(canvas);
  if (!at || !density) return;
  const { c, width, height } = at, { cells, planes, extent_wavelengths: extent } = density;
  const planesShown = planes.map(bothSigns), most = planesShown.flat().reduce((a, b) => Math.max(a, b), 1);
  const space = 8, side = Math.min((width - 2 * space) / 3, height - 18), left = (width - 3 * side - 2 * space) / 2;
  const colour = (count) => { const at = 3 * Math.round(255 * (most > 1 ? 0.25 + 0.75 * Math.log(count) / Math.log(most) : 1)); return colours.subarray(at, at + 3); };
  const empty = css("--field").slice(1).match(/../g).map((pair) => parseInt(pair, 16));
  planesShown.forEach((plane, n) => {
    const small = document.createElement("canvas"), image = new ImageData(cells, cells);
    small.width = small.height = cells;
    // The first row of a picture is at the top.
    for (let row = 0, k = 0; row < cells; row++) for (let column = 0; column < cells; column++, k += 4) {
      const count = plane[(cells - 1 - row) * cells + column];
      image.data.set([...(count ? colour(count) : empty), 255], k);
    }
    small.getContext("2d").putImageData(image, 0, 0);
    const x = left + n * (side + space);
    c.imageSmoothingEnabled = false;
    c.drawImage(small, x, 0, side, side);
    c.strokeStyle = css("--line"); c.strokeRect(x + 0.5, 0.5, side - 1, side - 1);
    c.fillStyle = css("--quiet"); c.textAlign = "center"; c.fillText(["u → , v ↑", "u → , w ↑", "v → , w ↑"][n], x + side / 2, side + 13);
  });
  const met = planesShown[0].filter(Boolean).length / (cells * cells);
  $("uvwtext").textContent = `±${short(extent)} wavelengths, ecliptic axes, both signs of ${number.format(density.visibilities)} visibilities of this session; one of ${density.every} is drawn. ${(100 * met).toFixed(1)} % of the u-v cells met.`;
}

/** Colour limits of powers: the quantiles of 1 % and 99 %. */
export function limitsOf(powers) {
  const sorted = Float64Array.from(powers.flat().filter((v) => v !== null)).sort(), at = (q) => sorted[Math.round(q * (sorted.length - 1))];
  const [low, high] = [at(0.01), at(0.99)];
  return high > low ? [low, high] : [low - 1, low + 1];
}

/** Draws powers: rows are daughters, columns the times with data. */
export function drawPowers(canvas, waterfall, colours, epochTaiS) {
  const at = brush(canvas);
  if (!at || !waterfall) return;
  const { c, width } = at, { times_s: times, powers_k_sr: powers, time_s: wide } = waterfall;
  const rows = Math.max(...powers.map((row) => row.length)), [low, high] = limitsOf(powers), left = 76, w = width - left - 4;
  const lane = 130 / rows;
  powers.forEach((row, k) => {
    const from = left + Math.floor(k / times.length * w), to = left + Math.floor((k + 1) / times.length * w);
    row.forEach((power, daughter) => {
      if (power === null) return;
      const at = 3 * Math.round(255 * Math.min(1, Math.max(0, (power - low) / (high - low))));
      c.fillStyle = `rgb(${colours.subarray(at, at + 3).join()})`;
      c.fillRect(from, Math.floor(daughter * lane), Math.max(1, to - from), Math.ceil(lane) - (lane > 8 ? 1 : 0));
    });
  });
  c.fillStyle = css("--quiet"); c.textBaseline = "middle"; c.textAlign = "right";
  for (let daughter = 0; daughter < rows; daughter++) if (lane > 9 || daughter % 4 === 0) c.fillText(`daughter ${daughter + 1}`, left - 6, (daughter + 0.5) * lane);
  c.textBaseline = "alphabetic"; c.textAlign = "left"; c.fillText(utc(epochTaiS, times[0]), left, 146);
  c.textAlign = "right"; c.fillText(`${utc(epochTaiS, times.at(-1) + wide)} UTC`, width - 4, 146);
  $("powerstext").textContent = `Means of ${short(wide)} s, one column each; times without any are left out. From ${short(low)} to ${short(high)} K sr.`;
}
