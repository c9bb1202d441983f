// The sky on a canvas: HEALPix RING pixels in ecliptic axes, drawn by WebGL2 from the raw numbers, or else by the CPU.

const UNSEEN = -1e30; // Values below it, and NaN, are unmeasured.
const SCALES = { linear: 0, log: 1, asinh: 2 };

/** Number of the pixel in the direction (x, y, z), a unit vector. */
export function pixelAt(nside, [x, y, z]) {
  let phi = Math.atan2(y, x);
  if (phi < 0) phi += 2 * Math.PI;
  const tt = (phi / (Math.PI / 2)) % 4, za = Math.abs(z);
  if (za <= 2 / 3) {
    const a = nside * (0.5 + tt), b = nside * z * 0.75;
    const jp = Math.floor(a - b), jm = Math.floor(a + b);
    const ring = nside + 1 + jp - jm, shift = 1 - (ring & 1);
    const ip = Math.floor((jp + jm - nside + shift + 1) / 2);
    return 2 * nside * (nside - 1) + (ring - 1) * 4 * nside + ((ip % (4 * nside)) + 4 * nside) % (4 * nside);
  }
  const tp = tt - Math.floor(tt), t = nside * Math.sqrt(3 * (1 - za));
  const jp = Math.floor(tp * t), jm = Math.floor((1 - tp) * t), ring = jp + jm + 1;
  const ip = Math.floor(tt * ring) % (4 * ring);
  return z > 0 ? 2 * ring * (ring - 1) + ip : 12 * nside * nside - 2 * ring * (ring + 1) + ip;
}

const VERTEX = `#version 300 es
in vec2 at; void main() { gl_Position = vec4(at, 0.0, 1.0); }`;

const FRAGMENT = `#version 300 es
precision highp float; precision highp int; precision highp sampler2D;
uniform sampler2D a, b, palette;
uniform vec2 size; uniform vec2 half_;
uniform mat3 to_map;
uniform int projection, nside, wide, mode, scale, smooth_, marks;
uniform vec2 limits; uniform float knee; uniform vec3 back;
out vec4 colour;
const float PI = 3.141592653589793;
int pixel(vec3 d) {
  float phi = atan(d.y, d.x); if (phi < 0.0) phi += 2.0 * PI;
  float tt = mod(phi * (2.0 / PI), 4.0), za = abs(d.z), n = float(nside);
  if (za <= 2.0 / 3.0) {
    float p = n * (0.5 + tt), q = n * d.z * 0.75;
    int jp = int(floor(p - q)), jm = int(floor(p + q));
    int ring = nside + 1 + jp - jm, shift = 1 - (ring & 1);
    int ip = (jp + jm - nside + shift + 1) >> 1, around = 4 * nside;
    ip = ((ip % around) + around) % around;
    return 2 * nside * (nside - 1) + (ring - 1) * around + ip;
  }
  float tp = fract(tt), t = n * sqrt(3.0 * (1.0 - za));
  int jp = int(floor(tp * t)), jm = int(floor((1.0 - tp) * t)), ring = jp + jm + 1;
  int ip = int(floor(tt * float(ring))) % (4 * ring);
  return d.z > 0.0 ? 2 * ring * (ring - 1) + ip : 12 * nside * nside - 2 * ring * (ring + 1) + ip;
}
bool seen(float v) { return v > -1e30 && v < 1e38; }
float value(vec3 d) {
  int p = clamp(pixel(d), 0, 12 * nside * nside - 1);
  ivec2 at = ivec2(p % wide, p / wide);
  float x = texelFetch(a, at, 0).r;
  if (mode == 0 || !seen(x)) return x;
  float y = texelFetch(b, at, 0).r;
  return seen(y) ? x - y : y;
}
float smoothed(vec3 d) {
  vec3 e = normalize(cross(d, abs(d.z) < 0.9 ? vec3(0.0, 0.0, 1.0) : vec3(1.0, 0.0, 0.0))), f = cross(d, e);
  float step_ = 0.55 * sqrt(PI / 3.0) / float(nside), sum = 0.0, weight = 0.0;
  for (int ring = 0; ring < 4; ring++) {
    int taps = ring == 0 ? 1 : 6 * ring;
    float r = float(ring) * step_ * 0.6, w = exp(-0.5 * float(ring * ring) * 0.45);
    for (int k = 0; k < taps; k++) {
      float turn = 2.0 * PI * (float(k) + 0.5 * float(ring & 1)) / float(taps);
      float v = value(normalize(d + r * (cos(turn) * e + sin(turn) * f)));
      if (seen(v)) { sum += w * v; weight += w; }
    }
  }
  return weight > 0.0 ? sum / weight : -1.6e30;
}
float place(float v) {
  if (scale == 1) return v > 0.0 ? log(v / limits.x) / log(limits.y / limits.x) : -1.0;
  if (scale == 2) { float l = asinh(limits.x / knee), h = asinh(limits.y / knee); return (asinh(v / knee) - l) / (h - l); }
  return (v - limits.x) / (limits.y - limits.x);
}
void main() {
  vec2 s = (gl_FragCoord.xy - 0.5 * size) / half_;
  vec3 d; float rim;
  if (projection == 0) {
    rim = length(s);
    if (rim > 1.0) { colour = vec4(back, 1.0); return; }
    float theta = asin(s.y), lon = -PI * s.x / max(cos(theta), 1e-5);
    float sine = clamp((2.0 * theta + sin(2.0 * theta)) / PI, -1.0, 1.0), c = sqrt(1.0 - sine * sine);
    d = vec3(c * cos(lon), c * sin(lon), sine);
  } else {
    rim = length(s);
    if (rim > 1.0) { colour = vec4(back, 1.0); return; }
    d = vec3(sqrt(1.0 - rim * rim), -s.x, s.y);
  }
  vec3 m = to_map * d;
  float v = smooth_ == 1 ? smoothed(m) : value(m);
  vec3 c;
  float stripe = mod(gl_FragCoord.x + gl_FragCoord.y, 9.0);
  if (!seen(v)) { c = stripe < 4.5 ? vec3(0.46) : vec3(0.6); }
  else {
    float p = clamp(place(v), 0.0, 1.0);
    c = texelFetch(palette, ivec2(int(p * 255.0 + 0.5), 0), 0).rgb;
    if (marks == 1 && mode == 0 && v < 0.0 && stripe < 2.0) c = mix(c, vec3(0.35, 0.75, 1.0), 0.75);
  }
  if (projection == 1) c *= 0.72 + 0.28 * sqrt(1.0 - rim * rim);
  float edge = (1.0 - rim) * min(half_.x, half_.y);
  colour = vec4(mix(back, c, clamp(edge, 0.0, 1.0)), 1.0);
}`;

const multiply = (p, q) => p.map((row) => [0, 1, 2].map((k) => row[0] * q[0][k] + row[1] * q[1][k] + row[2] * q[2][k]));
const transpose = (m) => [0, 1, 2].map((r) => [m[0][r], m[1][r], m[2][r]]);
const apply = (m, v) => m.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);

/** Position of a value on the scale, 0 to 1 within the limits. */
export function placeOf(v, { scale, low, high }) {
  if (scale === "log") return v > 0 ? Math.log(v / low) / Math.log(high / low) : -1;
  if (scale === "asinh") {
    const knee = kneeOf(low, high), l = Math.asinh(low / knee), h = Math.asinh(high / knee);
    return (Math.asinh(v / knee) - l) / (h - l);
  }
  return (v - low) / (high - low);
}
/** RMS of a map within a circle about a direction, with the area of a number of pixels, and the radius of the circle in degrees. */
export function rmsNear(values, direction, pixels) {
  const nside = Math.round(Math.sqrt(values.length / 12)), height = Math.min(2, 2 * pixels / values.length);
  const [x, y, z] = direction, side = Math.abs(z) < 0.9 ? [0, 0, 1] : [1, 0, 0];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  let e = cross(side, direction);
  e = e.map((v) => v / Math.hypot(...e));
  const f = cross(direction, e), count = 4 * pixels;
  let sum = 0, seen = 0;
  // Sample points on a spiral, with equal areas.
  for (let k = 0; k < count; k++) {
    const c = 1 - height * (k + 0.5) / count, s = Math.sqrt(1 - c * c), turn = 2.399963229728653 * k, [p, q] = [s * Math.cos(turn), s * Math.sin(turn)];
    const v = values[pixelAt(nside, [c * x + p * e[0] + q * f[0], c * y + p * e[1] + q * f[1], c * z + p * e[2] + q * f[2]])];
    if (isSeen(v)) { sum += v * v; seen += 1; }
  }
  return { rms: Math.sqrt(sum / seen), radius: Math.acos(1 - height) * 180 / Math.PI };
}

const kneeOf = (low, high) => 0.02 * Math.max(Math.abs(low), Math.abs(high), 1e-300);

export class Sky {
  constructor(canvas, over, constants) {
    this.canvas = canvas; this.over = over;
    this.frames = Object.fromEntries(constants.frames);
    this.palettes = Object.fromEntries(constants.palettes.map(([name, hex]) =>
      [name, Uint8Array.from(hex.match(/../g), (pair) => parseInt(pair, 16))]));
    this.view = { projection: "mollweide", frame: "galactic", lon: 0, lat: 0 };
    this.look = { scale: "log", palette: "inferno", low: 1, high: 2, smooth: false, marks: true };
    this.a = this.b = null;
    this.gl = canvas.getContext("webgl2", { antialias: false, preserveDrawingBuffer: true });
    if (this.gl) this.prepare();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { this.prepare(); this.upload(); this.draw(); });
  }

  prepare() {
    const gl = this.gl, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text); gl.compileShader(shader); gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS) && !gl.isContextLost()) console.error(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(program); gl.useProgram(program);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 3, -1, -1, 3]), gl.STATIC_DRAW);
    const at = gl.getAttribLocation(program, "at");
    gl.enableVertexAttribArray(at); gl.vertexAttribPointer(at, 2, gl.FLOAT, false, 0, 0);
    this.place = (name) => gl.getUniformLocation(program, name);
    this.textures = ["a", "b", "palette"].map((name, unit) => {
      const texture = gl.createTexture();
      gl.activeTexture(gl.TEXTURE0 + unit); gl.bindTexture(gl.TEXTURE_2D, texture);
      for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.NEAREST);
      for (const key of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, key, gl.CLAMP_TO_EDGE);
      gl.uniform1i(this.place(name), unit);
      return texture;
    });
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  }

  /** Shows `a`, or `a` - `b`, which have the same number of pixels. */
  show(a, b) {
    this.a = a; this.b = b && b.length === a?.length ? b : null;
    this.nside = a ? Math.round(Math.sqrt(a.length / 12)) : 0;
    this.upload();
  }

  upload() {
    if (!this.gl || !this.a) return;
    const gl = this.gl, wide = Math.min(this.a.length, 2048, gl.getParameter(gl.MAX_TEXTURE_SIZE));
    this.wide = wide;
    for (const [unit, values] of [[0, this.a], [1, this.b]]) {
      if (!values) continue;
      const rows = Math.ceil(values.length / wide), padded = new Float32Array(rows * wide);
      padded.set(values);
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.texImage2D(gl.TEXTURE_2D, 0, gl.R32F, wide, rows, 0, gl.RED, gl.FLOAT, padded);
    }
  }

  /** Rotation from the screen's axes (towards the centre, left, up) to the map's. */
  turn(view = this.view) {
    const { lon, lat, frame, projection } = view, tilt = projection === "globe" ? lat : 0;
    const [a, b] = [lon * Math.PI / 180, tilt * Math.PI / 180];
    const [ca, sa, cb, sb] = [Math.cos(a), Math.sin(a), Math.cos(b), Math.sin(b)];
    const turned = multiply([[ca, -sa, 0], [sa, ca, 0], [0, 0, 1]], [[cb, 0, -sb], [0, 1, 0], [sb, 0, cb]]);
    return { turned, toMap: multiply(transpose(this.frames[frame]), turned) };
  }

  /** Half the width and height of the sky, in pixels of the canvas. */
  half() {
    const { width, height } = this.canvas, margin = 0.985;
    if (this.view.projection === "globe") { const r = margin * Math.min(width, height) / 2; return [r, r]; }
    const r = margin * Math.min(width / 2, height);
    return [r, r / 2];
  }

  resize() {
    const ratio = Math.min(window.devicePixelRatio || 1, 2), box = this.canvas.getBoundingClientRect();
    for (const canvas of [this.canvas, this.over]) {
      const [width, height] = [Math.max(1, Math.round(box.width * ratio)), Math.max(1, Math.round(box.height * ratio))];
      if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
    }
    this.ratio = ratio;
  }

  draw() {
    this.resize();
    const style = getComputedStyle(document.documentElement), back = hexOf(style.getPropertyValue("--panel"));
    if (this.a) this.gl ? this.drawFast(back) : this.drawSlowly(back);
    this.drawGrid();
  }

  drawFast(back) {
    const gl = this.gl, { look, view } = this, { width, height } = this.canvas, u = this.place;
    const { toMap } = this.turn(), half = this.half();
    gl.viewport(0, 0, width, height);
    gl.activeTexture(gl.TEXTURE2);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, 256, 1, 0, gl.RGB, gl.UNSIGNED_BYTE, this.palettes[look.palette]);
    gl.uniform2f(u("size"), width, height); gl.uniform2f(u("half_"), half[0], half[1]);
    gl.uniformMatrix3fv(u("to_map"), false, transpose(toMap).flat());
    gl.uniform1i(u("projection"), view.projection === "globe" ? 1 : 0);
    gl.uniform1i(u("nside"), this.nside); gl.uniform1i(u("wide"), this.wide);
    gl.uniform1i(u("mode"), this.b ? 1 : 0); gl.uniform1i(u("scale"), SCALES[look.scale]);
    gl.uniform1i(u("smooth_"), look.smooth ? 1 : 0); gl.uniform1i(u("marks"), look.marks ? 1 : 0);
    gl.uniform2f(u("limits"), look.low, look.high); gl.uniform1f(u("knee"), kneeOf(look.low, look.high));
    gl.uniform3fv(u("back"), back.map((c) => c / 255));
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  drawSlowly(back) {
    const context = this.canvas.getContext("2d"), { width, height } = this.canvas;
    const image = context.createImageData(width, height), colours = this.palettes[this.look.palette];
    for (let y = 0, k = 0; y < height; y++) for (let x = 0; x < width; x++, k += 4) {
      const v = this.valueAt(x + 0.5, y + 0.5);
      let colour = back;
      if (v === undefined) colour = back;
      else if (!isSeen(v)) colour = [130, 130, 130];
      else {
        const at = 3 * Math.round(255 * Math.min(1, Math.max(0, placeOf(v, this.look))));
        colour = colours.subarray(at, at + 3);
        if (this.look.marks && !this.b && v < 0 && (x + y) % 9 < 2) colour = [110, 190, 255];
      }
      image.data.set([colour[0], colour[1], colour[2], 255], k);
    }
    context.putImageData(image, 0, 0);
  }

  /** Direction in the screen's axes of a position on the canvas, in pixels; undefined outside of the sky. */
  screenDirection(px, py) {
    const half = this.half(), s = [(px - this.canvas.width / 2) / half[0], (this.canvas.height / 2 - py) / half[1]];
    const r2 = s[0] * s[0] + s[1] * s[1];
    if (r2 > 1) return undefined;
    if (this.view.projection === "globe") return [Math.sqrt(1 - r2), -s[0], s[1]];
    const theta = Math.asin(s[1]), lon = -Math.PI * s[0] / Math.max(Math.cos(theta), 1e-5);
    const sine = Math.min(1, Math.max(-1, (2 * theta + Math.sin(2 * theta)) / Math.PI)), c = Math.sqrt(1 - sine * sine);
    return [c * Math.cos(lon), c * Math.sin(lon), sine];
  }

  valueAt(px, py) {
    const d = this.screenDirection(px, py);
    if (!d || !this.a) return undefined;
    return this.value(pixelAt(this.nside, apply(this.turn().toMap, d)));
  }

  value(pixel) {
    const x = this.a[pixel];
    if (!this.b || !isSeen(x)) return x;
    return isSeen(this.b[pixel]) ? x - this.b[pixel] : this.b[pixel];
  }

  /** Pixel and value below the mouse, with longitude and latitude (degrees) in the axes shown, and direction in the map's axes. */
  probe(clientX, clientY) {
    const box = this.canvas.getBoundingClientRect();
    const d = this.screenDirection((clientX - box.left) * this.ratio, (clientY - box.top) * this.ratio);
    if (!d || !this.a) return undefined;
    const { turned, toMap } = this.turn(), f = apply(turned, d), direction = apply(toMap, d), pixel = pixelAt(this.nside, direction);
    const lon = (Math.atan2(f[1], f[0]) * 180 / Math.PI + 360) % 360, lat = Math.asin(Math.max(-1, Math.min(1, f[2]))) * 180 / Math.PI;
    return { pixel, value: this.value(pixel), lon, lat, direction };
  }

  /** Position on the canvas of a direction in the axes shown; undefined on the far side. */
  project(lonDeg, latDeg) {
    const [lon, lat] = [lonDeg * Math.PI / 180, latDeg * Math.PI / 180];
    const f = [Math.cos(lat) * Math.cos(lon), Math.cos(lat) * Math.sin(lon), Math.sin(lat)];
    const d = apply(transpose(this.turn().turned), f), half = this.half();
    const put = (x, y) => [this.canvas.width / 2 + x * half[0], this.canvas.height / 2 - y * half[1]];
    if (this.view.projection === "globe") return d[0] < 0 ? undefined : put(-d[1], d[2]);
    const across = Math.atan2(d[1], d[0]), up = Math.asin(Math.max(-1, Math.min(1, d[2])));
    let theta = up;
    for (let k = 0; k < 12; k++) {
      const slope = 2 + 2 * Math.cos(2 * theta);
      if (slope < 1e-9) break;
      theta -= (2 * theta + Math.sin(2 * theta) - Math.PI * Math.sin(up)) / slope;
    }
    return put(-across / Math.PI * Math.cos(theta), Math.sin(theta));
  }

  drawGrid() {
    const c = this.over.getContext("2d"), half = this.half(), { width, height } = this.over;
    c.clearRect(0, 0, width, height);
    if (!this.a) return;
    c.lineWidth = this.ratio * 0.7; c.strokeStyle = "rgba(255,255,255,.28)";
    const line = (points) => {
      let before;
      c.beginPath();
      for (const [lon, lat] of points) {
        const at = this.project(lon, lat);
        if (at && before && Math.hypot(at[0] - before[0], at[1] - before[1]) < 0.2 * half[0]) c.lineTo(at[0], at[1]);
        else if (at) c.moveTo(at[0], at[1]);
        before = at;
      }
      c.stroke();
    };
    const steps = (from, to, step) => Array.from({ length: Math.round((to - from) / step) + 1 }, (_, k) => from + k * step);
    for (const lon of steps(0, 330, 30)) line(steps(-90, 90, 2).map((lat) => [lon, lat]));
    for (const lat of steps(-60, 60, 30)) line(steps(0, 360, 2).map((lon) => [lon, lat]));
    // White on a dark rim: readable on any colour of the maps.
    c.font = `600 ${11 * this.ratio}px system-ui, sans-serif`; c.fillStyle = "#fff"; c.textAlign = "center";
    c.strokeStyle = "#000"; c.lineWidth = 3 * this.ratio; c.lineJoin = "round";
    const write = (text, x, y) => { c.strokeText(text, x, y); c.fillText(text, x, y); };
    for (const lon of steps(0, 300, 60)) {
      const at = this.project(lon, 0), off = at && Math.abs(at[0] - width / 2) / half[0];
      if (at && off < 0.93) write(`${lon}°`, at[0], at[1] - 3 * this.ratio);
    }
    for (const lat of [-60, -30, 30, 60]) {
      const at = this.project(this.view.lon, lat);
      if (at) write(`${lat > 0 ? "+" : "−"}${Math.abs(lat)}°`, at[0] + 16 * this.ratio, at[1] - 3 * this.ratio);
    }
  }
}

export const isSeen = (v) => Number.isFinite(v) && v > UNSEEN;

function hexOf(text) {
  const digits = text.trim().slice(1);
  return [0, 2, 4].map((k) => parseInt(digits.slice(k, k + 2), 16) || 0);
}
