// The map in WebGL: surfels as discs, the path as wide lines, a turntable camera. z is up.

const POINT_VERTEX = `
attribute vec3 position; attribute vec2 extra; attribute vec3 color; attribute vec3 normal;
uniform mat4 view, projection; uniform vec3 low, range; uniform vec2 heights;
uniform float pixels, spacing, maxRadius; uniform int mode; uniform bool cull;
varying vec3 tone; varying vec3 disc; varying float size;
vec3 ramp(float t) {
  t = clamp(t, 0.0, 1.0) * 4.0;
  vec3 c = mix(vec3(0.267, 0.004, 0.329), vec3(0.231, 0.322, 0.545), clamp(t, 0.0, 1.0));
  c = mix(c, vec3(0.129, 0.569, 0.549), clamp(t - 1.0, 0.0, 1.0));
  c = mix(c, vec3(0.369, 0.788, 0.384), clamp(t - 2.0, 0.0, 1.0));
  return mix(c, vec3(0.992, 0.906, 0.145), clamp(t - 3.0, 0.0, 1.0));
}
void main() {
  vec3 p = low + position * range;
  vec4 seen = view * vec4(p, 1.0);
  vec3 n = mat3(view) * normal;
  bool has = dot(normal, normal) > 0.1;
  gl_Position = projection * seen;
  if (cull && has && dot(n, seen.xyz) > 0.0) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  float radius = max(extra.x * maxRadius, 1.1 * spacing);
  size = clamp(2.0 * radius * pixels / max(-seen.z, 0.001), 1.5, 64.0);
  gl_PointSize = size;
  disc = has ? n : vec3(0.0, 0.0, 1.0);
  float light = has ? 0.62 + 0.38 * abs(normalize(n).z) : 1.0;
  if (mode == 0) tone = color;
  else if (mode == 1) tone = 0.5 + 0.5 * normal;
  else if (mode == 2) tone = ramp(extra.y) * light;
  else tone = ramp((p.z - heights.x) / max(heights.y - heights.x, 0.001)) * light;
}`;

// A disc seen at an angle is an ellipse: a pixel belongs to it when its place in the plane is within the radius.
const POINT_FRAGMENT = `
precision mediump float;
varying vec3 tone; varying vec3 disc; varying float size;
void main() {
  vec2 c = vec2(2.0, -2.0) * gl_PointCoord + vec2(-1.0, 1.0);
  float slope = dot(disc.xy, c) / max(abs(disc.z), 0.4);
  if (size > 3.0 && dot(c, c) + slope * slope > 1.0) discard;
  gl_FragColor = vec4(tone, 1.0);
}`;

// A segment is two triangles. Its ends are as wide as the line is across the way from the point before to the point
// after, so that neighbours meet without a gap; ends behind the camera are drawn in to the near plane.
const LINE_VERTEX = `
attribute vec3 here, before, after; attribute float side, kind;
uniform mat4 both; uniform vec2 viewport; uniform float width; uniform vec4 colors[8];
varying vec4 tone; varying vec2 across;
vec4 drawnIn(vec4 p, vec4 q) {
  float near = 0.01;
  return p.w < near && q.w > near ? mix(p, q, (near - p.w) / (q.w - p.w)) : p;
}
void main() {
  vec4 p = both * vec4(here, 1.0), a = both * vec4(before, 1.0), b = both * vec4(after, 1.0);
  vec4 end = drawnIn(drawnIn(p, a), b);
  a = drawnIn(a, end);
  b = drawnIn(b, end);
  vec2 along = (b.xy / b.w - a.xy / a.w) * viewport;
  vec2 unit = length(along) > 0.0001 ? normalize(along) : vec2(1.0, 0.0);
  across = vec2(side * (0.5 * width + 1.0), 0.5 * width + 0.5);
  tone = colors[int(kind + 0.5)];
  bool hidden = tone.a == 0.0 || end.w < 0.005;
  gl_Position = hidden ? vec4(2.0, 2.0, 2.0, 1.0) : end + vec4(vec2(-unit.y, unit.x) * across.x * 2.0 / viewport * end.w, 0.0, 0.0);
}`;
const LINE_FRAGMENT = `
precision mediump float;
varying vec4 tone; varying vec2 across; uniform float alpha;
void main() { gl_FragColor = vec4(tone.rgb, tone.a * alpha * clamp(across.y - abs(across.x), 0.0, 1.0)); }`;

const LINE = { tracked: 0, lost: 1, unreadable: 2, degenerate: 3, truth: 4, loop: 5, frustum: 6 };
const LINE_COLORS = ["--accent", "--lost", "--unreadable", "--degenerate", "--truth", "--loop", "--ink"];
const FIELD_OF_VIEW = 0.8;
const RECORD = 16;  // bytes of a point in the buffer

function startViewer() {
  const canvas = document.getElementById("canvas");
  const gl = canvas.getContext("webgl", { antialias: true, alpha: false });
  let why = "WebGL is missing or switched off";
  try {
    if (gl) return void new Viewer(canvas, gl, report.data.scene);
  } catch (error) {
    why = error.message.split("\n")[0];
    console.error(error);
  }
  const message = document.getElementById("viewer-message");
  message.textContent = `This browser cannot draw the map: ${why}. The pictures further down show it, and map.ply opens in any viewer of point clouds.`;
  message.hidden = false;
  canvas.hidden = true;
  document.getElementById("path-legend").hidden = true;
  document.querySelector(".controls").hidden = true;
}

class Viewer {
  constructor(canvas, gl, scene) {
    Object.assign(this, { canvas, gl, scene });
    this.positions = floatsOf(scene.positions);
    this.rotations = floatsOf(scene.rotations);
    this.mode = 0;
    this.through = false;
    this.pending = false;
    this.drawn = scene.count;
    this.build();
    this.reset();
    this.readTheme();
    this.listen();
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { this.build(); this.draw(); });
    report.listeners.push(() => this.draw());
    this.draw();
  }

  // Buffers ---------------------------------------------------------------------------------------------------------

  build() {
    const { gl, scene } = this;
    this.points = this.program(POINT_VERTEX, POINT_FRAGMENT);
    this.lines = this.program(LINE_VERTEX, LINE_FRAGMENT);
    this.pointBuffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.pointBuffer);
    const columns = bytesOf(document.getElementById("points").textContent);
    gl.bufferData(gl.ARRAY_BUFFER, this.records(columns, scene.count), gl.STATIC_DRAW);
    this.sample = this.sampled(new Uint16Array(columns.buffer, 0, 3 * scene.count));
    this.pathBuffer = this.segments(this.pathSegments());
    this.truthBuffer = this.segments(this.truthSegments());
    this.frustumBuffer = { buffer: gl.createBuffer(), count: 0 };
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  /** Columns of the file as one record a point: x y z (uint16), radius, confidence, RGB, -, normal, -. */
  records(columns, n) {
    const records = new Uint8Array(n * RECORD);
    const at = { extra: 6 * n, color: 8 * n, normal: 11 * n };
    for (let i = 0; i < n; i++) {
      const r = i * RECORD;
      for (let k = 0; k < 6; k++) records[r + k] = columns[6 * i + k];
      records[r + 6] = columns[at.extra + i];
      records[r + 7] = columns[at.extra + n + i];
      for (let k = 0; k < 3; k++) {
        records[r + 8 + k] = columns[at.color + 3 * i + k];
        records[r + 12 + k] = columns[at.normal + 3 * i + k];
      }
    }
    return records;
  }

  /** Some points of the map, without outliers, and of the path: what a view should show. */
  sampled(grid) {
    const { low, high, inner } = this.scene;
    const found = [];
    for (let i = 0; i < Math.min(grid.length / 3, 600); i++) {
      const p = [0, 1, 2].map((k) => low[k] + (grid[3 * i + k] / 65535) * (high[k] - low[k]));
      if (p.every((value, k) => value >= inner[0][k] && value <= inner[1][k])) found.push(p);
    }
    const count = this.positions.length / 3;
    for (let i = 0; i < count; i += Math.max(1, Math.floor(count / 100))) found.push(this.position(i));
    return found;
  }

  position(i) {
    return [this.positions[3 * i], this.positions[3 * i + 1], this.positions[3 * i + 2]];
  }

  pathSegments() {
    const { scene } = this;
    const kinds = report.data.frames.kinds;
    const names = { t: "tracked", r: "tracked", l: "lost", u: "unreadable", s: "unreadable", d: "degenerate", m: "degenerate", e: "lost" };
    const rank = "trmdsule";  // of two ends the worse one gives the colour
    const found = [];
    const arm = 0.005 * this.diagonal();
    for (const k of scene.keyframes) {
      const p = this.position(k);
      for (let axis = 0; axis < 3; axis++) {
        const [a, b] = [[...p], [...p]];
        a[axis] -= arm;
        b[axis] += arm;
        found.push([a, b, LINE.loop]);
      }
    }
    for (const [i, j] of scene.loops) found.push([this.position(i), this.position(j), LINE.loop]);
    for (let i = 1; i < kinds.length; i++) {
      const kind = rank.indexOf(kinds[i]) > rank.indexOf(kinds[i - 1]) ? kinds[i] : kinds[i - 1];
      const ends = [this.position(Math.max(i - 2, 0)), this.position(Math.min(i + 1, kinds.length - 1))];
      found.push([this.position(i - 1), this.position(i), LINE[names[kind]], ...ends]);
    }
    for (const item of document.querySelectorAll("#path-legend li[data-kinds]")) {
      item.hidden = ![...item.dataset.kinds].some((kind) => kinds.includes(kind));
    }
    return found;
  }

  truthSegments() {
    const truth = this.scene.truth ? floatsOf(this.scene.truth) : [];
    const count = truth.length / 3, found = [];
    const at = (i) => truth.subarray(3 * Math.max(0, Math.min(count - 1, i))).subarray(0, 3);
    for (let i = 1; i < count; i++) found.push([at(i - 1), at(i), LINE.truth, at(i - 2), at(i + 1)]);
    return found;
  }

  /** Corners and edges of the camera of a frame. */
  frustumSegments(i) {
    const { camera } = this.scene;
    const deep = 0.05 * this.diagonal();
    const [w, h] = [(deep * camera.width) / (2 * camera.fx), (deep * camera.height) / (2 * camera.fy)];
    const R = this.rotations.subarray(9 * i, 9 * i + 9), c = this.position(i);
    const place = (x, y, z) => [0, 1, 2].map((k) => c[k] + R[3 * k] * x + R[3 * k + 1] * y + R[3 * k + 2] * z);
    const corners = [place(-w, -h, deep), place(w, -h, deep), place(w, h, deep), place(-w, h, deep)];
    const roof = place(0, -1.5 * h, deep);  // which side is up
    const kinds = { l: LINE.lost, u: LINE.unreadable, s: LINE.unreadable };
    const kind = kinds[report.data.frames.kinds[i]] ?? LINE.frustum;
    const edges = corners.flatMap((corner, k) => [[c, corner, kind], [corner, corners[(k + 1) % 4], kind]]);
    return [...edges, [corners[0], roof, kind], [roof, corners[1], kind]];
  }

  /** Triangles of segments [from, to, kind, point before, point after]; without the last two it stands alone. */
  segments(list, into = { buffer: this.gl.createBuffer(), count: 0 }) {
    const { gl } = this;
    const data = new Float32Array(list.length * 6 * 11);
    const corners = [[0, -1], [0, 1], [1, 1], [0, -1], [1, 1], [1, -1]];
    let at = 0;
    for (const [a, b, kind, previous = a, next = b] of list) {
      for (const [end, side] of corners) {
        data.set(end ? [...b, ...a, ...next, side, kind] : [...a, ...previous, ...b, side, kind], at);
        at += 11;
      }
    }
    gl.bindBuffer(gl.ARRAY_BUFFER, into.buffer);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    into.count = list.length * 6;
    return into;
  }

  program(vertex, fragment) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [type, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    const locations = { program };
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const name = gl.getActiveUniform(program, i).name.replace("[0]", "");
      locations[name] = gl.getUniformLocation(program, name);
    }
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_ATTRIBUTES); i++) {
      const name = gl.getActiveAttrib(program, i).name;
      locations[name] = gl.getAttribLocation(program, name);
    }
    return locations;
  }

  readTheme() {
    const style = getComputedStyle(document.documentElement);
    const rgb = (name) => {
      const hex = style.getPropertyValue(name).trim().slice(1);
      return [0, 2, 4].map((k) => parseInt(hex.slice(k, k + 2), 16) / 255);
    };
    this.background = rgb("--well");
    this.colors = LINE_COLORS.map(rgb);
  }

  // Camera ----------------------------------------------------------------------------------------------------------

  diagonal() {
    const [low, high] = this.scene.inner;
    return Math.hypot(...low.map((value, k) => high[k] - value)) || 1;
  }

  /** From behind and above the cameras, far enough for all of it. */
  reset() {
    const [low, high] = this.scene.inner;
    this.target = low.map((value, k) => (value + high[k]) / 2);
    const n = this.positions.length / 3, back = [0, 0];
    for (let i = 0; i < n; i++) for (let k = 0; k < 2; k++) back[k] += (this.positions[3 * i + k] - this.target[k]) / n;
    if (Math.hypot(...back) < 0.03 * this.diagonal()) [back[0], back[1]] = [-this.rotations[2], -this.rotations[5]];
    this.yaw = Math.atan2(back[1], back[0]);
    this.pitch = 0.6;
    this.distance = this.diagonal();
    this.fit();
  }

  /** Go to the distance from which all of the sample is in view. */
  fit() {
    this.through = false;
    const tall = Math.tan(FIELD_OF_VIEW / 2);
    const wide = (tall * this.canvas.clientWidth) / Math.max(this.canvas.clientHeight, 1);
    const { axes } = this.placed();
    const seen = this.sample.map((p) => axes.map((axis) => axis.reduce((sum, value, k) => sum + value * (p[k] - this.target[k]), 0)));
    // In the middle of what is seen, not of the box around it.
    for (let k = 0; k < 2; k++) {
      const values = seen.map((p) => p[k]);
      const middle = values.length ? (Math.min(...values) + Math.max(...values)) / 2 : 0;
      this.target = this.target.map((value, j) => value + middle * axes[k][j]);
      for (const p of seen) p[k] -= middle;
    }
    const needed = seen.map(([x, y, z]) => z + 1.22 * Math.max(Math.abs(x) / wide, Math.abs(y) / tall));
    this.distance = Math.max(0.1 * this.diagonal(), ...needed);
    this.leave();
  }

  leave() {
    this.through = false;
    document.getElementById("view-camera").setAttribute("aria-pressed", "false");
    this.draw();
  }

  /** World axes of the view (rows: right, up, back) and its eye. */
  placed() {
    if (this.through) {
      const R = this.rotations.subarray(9 * report.frame, 9 * report.frame + 9);
      const column = (k, sign) => [sign * R[k], sign * R[3 + k], sign * R[6 + k]];
      return { axes: [column(0, 1), column(1, -1), column(2, -1)], eye: this.position(report.frame) };
    }
    const [sy, cy, sp, cp] = [Math.sin(this.yaw), Math.cos(this.yaw), Math.sin(this.pitch), Math.cos(this.pitch)];
    const back = [cy * cp, sy * cp, sp];
    const axes = [[-sy, cy, 0], [-cy * sp, -sy * sp, cp], back];
    return { axes, eye: this.target.map((value, k) => value + this.distance * back[k]) };
  }

  turn(right, up) {
    if (this.through) this.leave();
    this.yaw -= right;
    this.pitch = Math.max(-1.5, Math.min(1.57, this.pitch + up));
    this.draw();
  }

  /** Move the target by pixels of the screen. */
  pan(right, down) {
    if (this.through) this.leave();
    const scale = (2 * this.distance * Math.tan(FIELD_OF_VIEW / 2)) / this.canvas.clientHeight;
    const { axes } = this.placed();
    this.target = this.target.map((value, k) => value + scale * (down * axes[1][k] - right * axes[0][k]));
    this.draw();
  }

  zoom(factor) {
    if (this.through) this.leave();
    this.distance = Math.max(0.02 * this.diagonal(), Math.min(8 * this.diagonal(), this.distance * factor));
    this.draw();
  }

  // Drawing ---------------------------------------------------------------------------------------------------------

  /** Draw before the next refresh. */
  draw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame((now) => {
      this.pending = false;
      this.pace(now);
      this.render();
    });
  }

  /** On a slow machine draw fewer points while the view moves, and all of them once it rests. */
  pace(now) {
    const between = now - (this.last ?? 0);
    this.last = now;
    const { count } = this.scene;
    if (between < 250) this.drawn = between > 60 ? Math.max(this.drawn * 0.6, Math.min(count, 20000)) : Math.min(this.drawn * 1.15, count);
    clearTimeout(this.rest);
    if (this.drawn < count) this.rest = setTimeout(() => { this.drawn = count; this.last = 0; this.draw(); }, 300);
  }

  render() {
    const { gl, canvas, scene } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const [width, height] = [Math.round(canvas.clientWidth * ratio), Math.round(canvas.clientHeight * ratio)];
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    const { axes, eye } = this.placed();
    const view = new Float32Array(16);
    for (let row = 0; row < 3; row++) {
      for (let k = 0; k < 3; k++) view[4 * k + row] = axes[row][k];
      view[12 + row] = -axes[row].reduce((sum, value, k) => sum + value * eye[k], 0);
    }
    view[15] = 1;
    const { camera } = scene;
    const fov = this.through ? 2 * Math.atan(camera.height / (2 * camera.fy)) : FIELD_OF_VIEW;
    const [near, far] = [this.through ? 0.01 : 0.02 * this.distance, this.distance + 20 * this.diagonal()];
    const f = 1 / Math.tan(fov / 2);
    const projection = new Float32Array(16);
    projection[0] = (f * height) / width;
    projection[5] = f;
    projection[10] = (far + near) / (near - far);
    projection[11] = -1;
    projection[14] = (2 * far * near) / (near - far);
    this.drawPoints(view, projection, (f * height) / 2);
    const both = new Float32Array(16);
    for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) for (let k = 0; k < 4; k++) both[4 * c + r] += projection[4 * k + r] * view[4 * c + k];
    const shown = (id) => document.getElementById(id).checked;
    const alphas = [0, 1, 2, 3, 4, 5, 6].map((kind) => (kind === LINE.truth ? shown("show-truth") : kind === LINE.loop ? shown("show-loops") : kind === LINE.frustum || shown("show-path")) ? 1 : 0);
    const colors = new Float32Array(32);
    this.colors.forEach((color, kind) => colors.set([...color, alphas[kind]], 4 * kind));
    this.drawLines(this.truthBuffer, both, colors, 6 * ratio, width, height);
    this.drawLines(this.pathBuffer, both, colors, 3 * ratio, width, height);
    if (!this.through) {
      for (let kind = 0; kind < 4; kind++) colors[4 * kind + 3] = 1;  // the camera is there without the path, too
      this.drawLines(this.segments(this.frustumSegments(report.frame), this.frustumBuffer), both, colors, 2.5 * ratio, width, height);
    }
  }

  attributes(program, stride, list) {
    const { gl } = this;
    for (const [name, size, type, normalised, offset] of list) {
      gl.enableVertexAttribArray(program[name]);
      gl.vertexAttribPointer(program[name], size, type, normalised, stride, offset);
    }
  }

  drawPoints(view, projection, pixels) {
    const { gl, scene, points: p } = this;
    gl.useProgram(p.program);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.pointBuffer);
    this.attributes(p, RECORD, [
      ["position", 3, gl.UNSIGNED_SHORT, true, 0], ["extra", 2, gl.UNSIGNED_BYTE, true, 6],
      ["color", 3, gl.UNSIGNED_BYTE, true, 8], ["normal", 3, gl.BYTE, true, 12],
    ]);
    gl.uniformMatrix4fv(p.view, false, view);
    gl.uniformMatrix4fv(p.projection, false, projection);
    gl.uniform3fv(p.low, scene.low);
    gl.uniform3fv(p.range, scene.high.map((value, k) => value - scene.low[k]));
    gl.uniform2f(p.heights, scene.inner[0][2], scene.inner[1][2]);
    gl.uniform1f(p.pixels, pixels);
    const part = Math.min(this.drawn, scene.count);
    gl.uniform1f(p.spacing, scene.spacing * Math.sqrt(scene.count / Math.max(part, 1)));
    gl.uniform1f(p.maxRadius, scene.maxRadius);
    gl.uniform1i(p.mode, this.mode);
    gl.uniform1i(p.cull, document.getElementById("cull").checked ? 1 : 0);
    gl.drawArrays(gl.POINTS, 0, Math.floor(part));
  }

  /** What is behind the map shows through it, faintly. */
  drawLines({ buffer, count }, both, colors, lineWidth, width, height) {
    const { gl, lines: l } = this;
    gl.useProgram(l.program);
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    this.attributes(l, 44, [
      ["here", 3, gl.FLOAT, false, 0], ["before", 3, gl.FLOAT, false, 12], ["after", 3, gl.FLOAT, false, 24],
      ["side", 1, gl.FLOAT, false, 36], ["kind", 1, gl.FLOAT, false, 40],
    ]);
    gl.uniformMatrix4fv(l.both, false, both);
    gl.uniform2f(l.viewport, width, height);
    gl.uniform1f(l.width, lineWidth);
    gl.uniform4fv(l.colors, colors);
    gl.enable(gl.BLEND);
    gl.depthMask(false);  // of lines that cross the last one is on top
    for (const [alpha, hidden] of [[0.3, true], [1, false]]) {
      gl.uniform1f(l.alpha, alpha);
      if (hidden) gl.disable(gl.DEPTH_TEST);
      gl.drawArrays(gl.TRIANGLES, 0, count);
      gl.enable(gl.DEPTH_TEST);
    }
    gl.depthMask(true);
    gl.disable(gl.BLEND);
  }

  // Hands -----------------------------------------------------------------------------------------------------------

  listen() {
    const { canvas } = this;
    const fingers = new Map();
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      fingers.set(event.pointerId, [event.clientX, event.clientY]);
      canvas.focus({ preventScroll: true });
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const now = [event.clientX, event.clientY], moved = [now[0] - before[0], now[1] - before[1]];
      if (fingers.size >= 2) {
        const other = [...fingers].find(([id]) => id !== event.pointerId)[1];
        const gap = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
        this.zoom(gap(before) / gap(now));
        this.pan(moved[0] / 2, moved[1] / 2);
      } else if (event.shiftKey || event.buttons & 6) this.pan(moved[0], moved[1]);
      else this.turn(moved[0] * 0.006, moved[1] * 0.006);
      fingers.set(event.pointerId, now);
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (event) => fingers.delete(event.pointerId));
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("wheel", (event) => {
      if (document.activeElement !== canvas && !event.ctrlKey) return;  // the page scrolls until the map is clicked
      event.preventDefault();
      this.zoom(Math.exp(Math.max(-60, Math.min(60, event.deltaY)) * 0.004));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => this.key(event));
    for (const radio of document.querySelectorAll("input[name=mode]")) {
      radio.addEventListener("change", () => { this.mode = Number(radio.value); this.scale(); this.draw(); });
    }
    for (const id of ["show-path", "show-truth", "show-loops", "cull"]) document.getElementById(id).addEventListener("change", () => this.draw());
    document.getElementById("view-reset").addEventListener("click", () => this.reset());
    document.getElementById("view-top").addEventListener("click", () => { this.pitch = 1.57; this.fit(); });
    document.getElementById("view-camera").addEventListener("click", (event) => {
      this.through = !this.through;
      event.currentTarget.setAttribute("aria-pressed", String(this.through));
      this.draw();
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { this.readTheme(); this.draw(); });
    window.addEventListener("beforeprint", () => this.render());
    window.addEventListener("resize", () => this.draw());
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const arrows = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const arrow = arrows[event.key];
    if (arrow && event.shiftKey) this.pan(-30 * arrow[0], -30 * arrow[1]);
    else if (arrow) this.turn(-0.08 * arrow[0], -0.08 * arrow[1]);
    else if (event.key === "+" || event.key === "=") this.zoom(0.87);
    else if (event.key === "-") this.zoom(1.15);
    else if (event.key === "0" || event.key === "Home") this.reset();
    else if (event.key === "," || event.key === ".") report.look(report.frame + (event.key === "." ? 1 : -1));
    else return;
    event.preventDefault();
  }

  /** Legend of the colours that stand for a number. */
  scale() {
    const ends = { 2: ["0", told(this.scene.maxConfidence)], 3: this.scene.inner.map((end) => `${(end[2] - this.scene.inner[0][2]).toFixed(1)} m`) }[this.mode];
    document.getElementById("scale").hidden = !ends;
    if (ends) ["scale-low", "scale-high"].forEach((id, k) => { document.getElementById(id).textContent = ends[k]; });
  }
}
