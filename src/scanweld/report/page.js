"use strict";
// Shared by the charts and the map: the data of the page, and the frame that is looked at.

const report = {
  data: JSON.parse(document.getElementById("data").textContent),
  frame: 0,
  listeners: [],

  /** Look at frame i (an index into the frames of this page). */
  look(i) {
    const frame = Math.max(0, Math.min(this.data.frames.count - 1, Math.round(i)));
    this.frame = frame;
    for (const listen of this.listeners) listen(frame);
  },
};

/** Bytes of base64 text. */
function bytesOf(text) {
  const binary = atob(text);
  const bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

/** Numbers that were written as base64 of little-endian float32. */
function floatsOf(text) {
  return new Float32Array(bytesOf(text).buffer);
}

/** A number for a person. */
function told(value) {
  const size = Math.abs(value);
  if (size >= 1000) return Math.round(value).toLocaleString("en");
  return String(Number(value.toPrecision(3)));
}

/** Name of the class of a kind of frame, "" for plainly tracked ones. */
const KIND_CLASS = { t: "", l: "lost", u: "unreadable", s: "dropped", r: "relocalised", d: "degenerate", m: "unfinished", e: "elsewhere" };

/** Runs of frames that were not plainly tracked: [first, last, class]. */
function bands() {
  const kinds = report.data.frames.kinds;
  const found = [];
  let first = 0;
  for (let i = 1; i <= kinds.length; i++) {
    if (i < kinds.length && kinds[i] === kinds[first]) continue;
    if (KIND_CLASS[kinds[first]]) found.push([first, i - 1, KIND_CLASS[kinds[first]]]);
    first = i;
  }
  return found;
}

function startPage() {
  const frames = report.data.frames;
  const times = floatsOf(frames.time);
  const slider = document.getElementById("slider");
  const play = document.getElementById("play");
  const line = document.getElementById("frame-line");
  let timer = 0;

  slider.addEventListener("input", () => { stop(); report.look(Number(slider.value)); });
  report.listeners.push((i) => {
    slider.value = i;
    const kind = frames.kinds[i];
    const note = frames.texts[frames.notes[i]];
    const text = `frame ${frames.numbers[i]}, ${times[i].toFixed(2)} s: ${frames.names[kind]}`;
    slider.setAttribute("aria-valuetext", text);
    line.setAttribute("aria-live", timer ? "off" : "polite");
    line.textContent = "";
    const state = document.createElement("span");
    state.className = `state ${KIND_CLASS[kind]}`;
    state.textContent = frames.names[kind];
    line.append(`Frame ${frames.numbers[i]} · ${times[i].toFixed(2)} s · `, state, note ? ` · ${note}` : "");
  });

  function stop() {
    clearInterval(timer);
    timer = 0;
    play.textContent = "Play";
    play.setAttribute("aria-pressed", "false");
  }
  play.addEventListener("click", () => {
    if (timer) { stop(); return; }
    // The whole path in about twelve seconds, however long it is.
    const step = Math.max(1, Math.round(frames.count / 240));
    if (report.frame >= frames.count - 1) report.look(0);
    timer = setInterval(() => {
      report.look(report.frame + step);
      if (report.frame >= frames.count - 1) stop();
    }, Math.max(40, Math.min(200, 12000 / frames.count)));
    play.textContent = "Pause";
    play.setAttribute("aria-pressed", "true");
  });
  for (const button of document.querySelectorAll("button.go")) {
    button.addEventListener("click", () => {
      stop();
      const at = frames.numbers.findIndex((number) => number >= Number(button.dataset.frame));
      report.look(at < 0 ? frames.count - 1 : at);
      document.getElementById("map").scrollIntoView();
      slider.focus({ preventScroll: true });
    });
  }
}

// The words are on the screen before the charts and the map are made.
function start() {
  startPage();
  startCharts();
  report.look(0);
  requestAnimationFrame(() => setTimeout(() => {
    startViewer();
    report.look(report.frame);
    document.documentElement.dataset.ready = "yes";
  }, 0));
}

document.addEventListener("DOMContentLoaded", start);
