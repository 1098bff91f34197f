// Charts as SVG at the width they have, and the strip of states above the slider.

const SVG = "http://www.w3.org/2000/svg";
const MARGIN = { left: 46, right: 12, top: 8, bottom: 34 };

function svg(name, attributes, text) {
  const node = document.createElementNS(SVG, name);
  for (const key in attributes) node.setAttribute(key, attributes[key]);
  if (text !== undefined) node.textContent = text;
  return node;
}

/** Round numbers between low and high, about `count` of them. */
function ticks(low, high, count) {
  const raw = (high - low) / Math.max(count, 1) || 1;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999);
  const found = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-6; k++) found.push(Number((k * step).toPrecision(12)));
  return found;
}

/** A path through points; where there are many a pixel, its lowest and highest are enough. Gaps are where y is NaN. */
function pathOf(xs, ys, toX, toY, width) {
  const n = ys.length;
  const bucket = Math.max(1, Math.floor(n / (2 * width)));
  let path = "", pen = "M";
  const put = (i) => { path += `${pen}${toX(xs ? xs[i] : i).toFixed(1)} ${toY(ys[i]).toFixed(1)}`; pen = "L"; };
  for (let start = 0; start < n; start += bucket) {
    let low = -1, high = -1;
    for (let i = start; i < Math.min(n, start + bucket); i++) {
      if (Number.isNaN(ys[i])) continue;
      if (low < 0 || ys[i] < ys[low]) low = i;
      if (high < 0 || ys[i] > ys[high]) high = i;
    }
    if (low < 0) { pen = "M"; continue; }
    put(Math.min(low, high));
    if (low !== high) put(Math.max(low, high));
  }
  return path;
}

class Chart {
  constructor(plot, spec) {
    this.plot = plot;
    this.spec = spec;
    this.readout = plot.closest("figure").querySelector(".readout");
    this.series = spec.series.map((s) => ({ name: s.name, y: floatsOf(s.y), x: s.x ? floatsOf(s.x) : null }));
    if (spec.stacked) this.stack();
    const move = (event) => {
      const at = this.nearest(event);
      if (at === null) return;
      this.point(at);
      if (event.type === "pointerdown" && spec.kind === "frames") report.look(at);
    };
    plot.addEventListener("pointermove", move);
    plot.addEventListener("pointerdown", move);
    plot.addEventListener("pointerleave", () => this.point(spec.kind === "frames" ? report.frame : null));
    if (spec.kind === "frames") report.listeners.push((frame) => this.point(frame));
  }

  /** Series on top of each other; `own` keeps their own values. */
  stack() {
    let below = new Float32Array(this.series.length ? this.series[0].y.length : 0);
    for (const s of this.series) {
      s.own = s.y;
      s.below = below;
      s.y = s.own.map((value, i) => value + below[i]);
      below = s.y;
    }
  }

  draw() {
    const { kind, unit, xLabel } = this.spec;
    const width = Math.max(this.plot.clientWidth, 120), height = this.plot.clientHeight;
    const inner = { width: width - MARGIN.left - MARGIN.right, height: height - MARGIN.top - MARGIN.bottom };
    let [x0, x1, y0, y1] = this.range();
    if (kind === "path") {  // one scale for both axes
      const scale = Math.max((x1 - x0) / inner.width, (y1 - y0) / inner.height, 1e-9) * 1.06;
      const [cx, cy] = [(x0 + x1) / 2, (y0 + y1) / 2];
      [x0, x1] = [cx - scale * inner.width / 2, cx + scale * inner.width / 2];
      [y0, y1] = [cy - scale * inner.height / 2, cy + scale * inner.height / 2];
    }
    const toX = (x) => MARGIN.left + ((x - x0) / (x1 - x0 || 1)) * inner.width;
    const toY = (y) => MARGIN.top + (1 - (Math.min(y, y1) - y0) / (y1 - y0 || 1)) * inner.height;
    this.geometry = { x0, x1, inner, toX, toY };
    const root = svg("svg", { width, height, "aria-hidden": "true" });
    const floor = MARGIN.top + inner.height;
    if (kind === "frames") {
      for (const [first, last, name] of bands()) {
        const left = toX(first - 0.5), wide = Math.max(toX(last + 0.5) - left, 1);
        root.append(svg("rect", { class: `band ${name}`, x: left, y: MARGIN.top, width: wide, height: inner.height }));
      }
    }
    for (const y of ticks(y0, y1, inner.height / 34)) {
      root.append(svg("line", { class: "grid", x1: MARGIN.left, x2: width - MARGIN.right, y1: toY(y), y2: toY(y) }));
      root.append(svg("text", { x: MARGIN.left - 6, y: toY(y) + 4, "text-anchor": "end" }, told(y)));
    }
    const numbers = report.data.frames.numbers;
    for (const x of ticks(x0, x1, inner.width / 80)) {
      if (kind === "frames" && (x < 0 || x > numbers.length - 1 || x % 1)) continue;
      const text = kind === "frames" ? numbers[x] : told(x);
      root.append(svg("text", { x: toX(x), y: floor + 15, "text-anchor": "middle" }, text));
    }
    root.append(svg("text", { x: width - MARGIN.right, y: floor + 30, "text-anchor": "end" }, xLabel));
    this.series.forEach((s, k) => {
      const line = pathOf(s.x, s.y, toX, toY, inner.width);
      if (s.below) {
        const back = pathOf(null, s.below, toX, toY, inner.width).replace(/^M/, "").split("L").reverse().join("L");
        root.append(svg("path", { class: `area part s${k + 1}`, d: `${line}L${back}Z` }));
        return;
      }
      root.append(svg("path", { class: `curve s${k + 1}`, d: line }));
      if (kind === "lines") {
        s.y.forEach((y, i) => root.append(svg("circle", { class: `dot s${k + 1}`, r: 4, cx: toX(s.x[i]), cy: toY(y) })));
      }
    });
    this.cursor = svg("line", { class: "cursor", y1: MARGIN.top, y2: floor, visibility: "hidden" });
    root.append(this.cursor);
    this.plot.replaceChildren(root);
    if (kind === "frames") this.point(report.frame);
  }

  range() {
    let [x0, x1, y0, y1] = [Infinity, -Infinity, Infinity, -Infinity];
    for (const s of this.series) {
      s.y.forEach((y, i) => {
        if (Number.isNaN(y)) return;
        const x = s.x ? s.x[i] : i;
        if (x < x0) x0 = x;
        if (x > x1) x1 = x;
        if (y < y0) y0 = y;
        if (y > y1) y1 = y;
      });
    }
    if (x0 > x1) [x0, x1, y0, y1] = [0, 1, 0, 1];
    if (this.spec.kind === "path") return [x0, x1, y0, y1];
    if (this.spec.kind === "frames") [x0, x1] = [-0.5, Math.max(report.data.frames.count - 0.5, 0.5)];
    else x0 = 0;
    const top = this.spec.top === null ? y1 * 1.06 : this.spec.top;
    return [x0, x1, 0, top > 0 ? top : 1];
  }

  /** The index below the pointer, or null. */
  nearest(event) {
    if (!this.geometry || this.spec.kind === "path") return null;
    const { x0, x1, inner } = this.geometry;
    const x = x0 + ((event.clientX - this.plot.getBoundingClientRect().left - MARGIN.left) / inner.width) * (x1 - x0);
    if (this.spec.kind === "frames") return Math.max(0, Math.min(report.data.frames.count - 1, Math.round(x)));
    const xs = this.series[0].x;
    return xs.reduce((best, value, i) => (Math.abs(value - x) < Math.abs(xs[best] - x) ? i : best), 0);
  }

  /** Put the cursor at an index and say what is there. */
  point(at) {
    if (!this.cursor) return;
    if (at === null) {
      this.cursor.setAttribute("visibility", "hidden");
      this.readout.textContent = "";
      return;
    }
    const frames = this.spec.kind === "frames";
    const x = this.geometry.toX(frames ? at : this.series[0].x[at]);
    for (const end of ["x1", "x2"]) this.cursor.setAttribute(end, x);
    this.cursor.setAttribute("visibility", "visible");
    const values = this.series.map((s) => (s.own || s.y)[at]);
    const value = this.spec.stacked ? values.reduce((a, b) => a + b, 0) : values[0];
    const unit = this.spec.unit === "thousand surfels" ? "k" : this.spec.unit;
    const what = Number.isNaN(value) ? "–" : `${told(value)} ${unit}`;
    this.readout.textContent = frames ? `${report.data.frames.numbers[at]}: ${what}` : `${told(this.series[0].x[at])} m: ${what}`;
  }
}

function drawTimeline() {
  const strip = document.getElementById("timeline");
  const width = strip.clientWidth, height = strip.clientHeight, count = report.data.frames.count;
  const root = svg("svg", { width, height });
  for (const [first, last, name] of bands()) {
    const wide = Math.max(((last - first + 1) / count) * width, 2);
    root.append(svg("rect", { class: `band ${name}`, x: (first / count) * width, y: 0, width: wide, height }));
  }
  strip.replaceChildren(root);
}

function startCharts() {
  const charts = [...document.querySelectorAll(".plot")].map((plot) => new Chart(plot, report.data.charts[plot.dataset.chart]));
  let drawn = 0;
  const drawAll = () => {
    if (drawn === window.innerWidth) return;
    drawn = window.innerWidth;
    for (const chart of charts) chart.draw();
    drawTimeline();
  };
  drawAll();
  window.addEventListener("resize", drawAll);
}
