"use strict";
// Linked slices of several volumes. The server sends a slice in half precision; windows are a table of 65536 greys.

const PLANES = [
  { name: "axial", axis: 0, up: 1, across: 2 },
  { name: "coronal", axis: 1, up: 0, across: 2 },
  { name: "sagittal", axis: 2, up: 0, across: 1 },
];
const LETTERS = ["z", "y", "x"];
const KEPT = 160; // slices in memory
const byId = (id) => document.getElementById(id);

let about, halves, greys, windows = 0; // grey tables made so far
const state = { point: [0, 0, 0], window: [0, 1], mode: "swipe", left: 0, right: 0, swipe: 0.5 };
const cache = new Map();
let panels = [];

function halfValues(scale) {
  const values = new Float32Array(65536);
  for (let code = 0; code < 65536; code++) {
    const sign = code & 0x8000 ? -1 : 1, exponent = (code >> 10) & 31, rest = code & 1023;
    const size = exponent ? 2 ** (exponent - 15) * (1 + rest / 1024) : 2 ** -14 * (rest / 1024);
    values[code] = (sign * size) / scale;
  }
  return values;
}

function greyTable([low, high]) {
  const table = new Uint32Array(65536), times = 255 / Math.max(high - low, 1e-30);
  for (let code = 0; code < 65536; code++) {
    const grey = Math.max(0, Math.min(255, Math.round((halves[code] - low) * times)));
    table[code] = 0xff000000 | (grey << 16) | (grey << 8) | grey;
  }
  return table;
}

// From orange over white to purple, which readers of every kind of colour vision tell apart.
const DIVERGING = Uint32Array.from({ length: 511 }, (_, k) => {
  const t = (k - 255) / 255, end = t < 0 ? [179, 88, 6] : [84, 39, 136];
  const [r, g, b] = end.map((c) => Math.round(247 + (c - 247) * Math.abs(t)));
  return 0xff000000 | (b << 16) | (g << 8) | r;
});

async function slice(volume, axis, index) {
  const key = `${volume}/${axis}/${index}`;
  if (!cache.has(key)) {
    const answer = fetch(`slice/${key}`).then(async (reply) => {
      if (!reply.ok) throw new Error(`slice ${key}: ${reply.status}`);
      return new Uint16Array(await reply.arrayBuffer());
    });
    cache.set(key, answer);
    answer.catch(() => cache.delete(key));
    if (cache.size > KEPT) cache.delete(cache.keys().next().value);
  }
  return cache.get(key);
}

// A picture of a slice with its first row at the bottom; made anew only where another slice or window is asked for, as
// a slider moves one plane of three.
function picture(panel, slot, key, codes, other) {
  const { up, across } = panel.plane, width = about.shape[across], height = about.shape[up];
  const kept = (panel.buffers[slot] ??= blank(width, height));
  key = `${key}/${windows}`;
  if (kept.key === key) return kept.canvas;
  const { pixels } = kept, times = 510 / Math.max(state.window[1] - state.window[0], 1e-30);
  for (let row = 0; row < height; row++) {
    let from = row * width, to = (height - 1 - row) * width;
    for (const end = from + width; from < end; from++, to++) {
      if (!other) pixels[to] = greys[codes[from]];
      else {
        const step = Math.round((halves[codes[from]] - halves[other[from]]) * times);
        pixels[to] = DIVERGING[255 + Math.max(-255, Math.min(255, step))];
      }
    }
  }
  kept.context.putImageData(kept.image, 0, 0);
  kept.key = key;
  return kept.canvas;
}

function blank(width, height) {
  const canvas = new OffscreenCanvas(width, height), context = canvas.getContext("2d");
  const image = context.createImageData(width, height);
  return { canvas, context, image, pixels: new Uint32Array(image.data.buffer), key: "" };
}

async function paint(panel) {
  const { plane, canvas } = panel, { axis, up, across } = plane, index = state.point[axis];
  const both = panel.volumes.length > 1;
  const codes = await Promise.all(panel.volumes.map((volume) => slice(volume, axis, index)));
  const difference = state.mode === "difference" && both;
  const shown = difference
    ? [picture(panel, 0, `${panel.volumes}/${index}`, codes[0], codes[1])]
    : codes.map((c, k) => picture(panel, k, `${panel.volumes[k]}/${index}`, c));
  const wide = Math.max(1, Math.round(canvas.clientWidth * devicePixelRatio));
  const tall = Math.round((wide * about.shape[up] * about.voxel[up]) / (about.shape[across] * about.voxel[across]));
  if (canvas.width !== wide || canvas.height !== tall) Object.assign(canvas, { width: wide, height: tall });
  const context = canvas.getContext("2d");
  context.imageSmoothingEnabled = wide < about.shape[across];
  context.drawImage(shown[0], 0, 0, wide, tall);
  if (shown.length > 1) divide(context, shown[1], wide, tall);
  cross(context, plane, wide, tall);
  bar(context, plane, wide, tall, difference);
  canvas.dataset.shown = `${panel.volumes}:${axis}:${index}`;
}

function divide(context, right, wide, tall) {
  const at = Math.round(state.swipe * wide);
  context.save();
  context.beginPath();
  context.rect(at, 0, wide - at, tall);
  context.clip();
  context.drawImage(right, 0, 0, wide, tall);
  context.restore();
  context.fillStyle = "#0072b2";
  context.fillRect(at - 1, 0, 2, tall);
}

function cross(context, { up, across }, wide, tall) {
  const x = ((state.point[across] + 0.5) / about.shape[across]) * wide;
  const y = (1 - (state.point[up] + 0.5) / about.shape[up]) * tall;
  context.fillStyle = "rgba(230, 159, 0, 0.75)";
  context.fillRect(Math.round(x), 0, 1, tall);
  context.fillRect(0, Math.round(y), wide, 1);
}

function bar(context, { across }, wide, tall, dark) {
  const whole = about.shape[across] * about.voxel[across], most = 0.3 * whole;
  const power = 10 ** Math.floor(Math.log10(most));
  const length = [5, 2, 1].map((times) => times * power).find((one) => one <= most);
  context.fillStyle = dark ? "#000" : "#fff";
  context.fillRect(0.04 * wide, 0.96 * tall, (length / whole) * wide, 3 * devicePixelRatio);
  context.font = `${Math.round(12 * devicePixelRatio)}px system-ui, sans-serif`;
  context.fillText(`${Number(length.toPrecision(2))} ${about.unit}`, 0.04 * wide, 0.945 * tall);
}

let busy = false, again = false;
async function draw() {
  if (busy) return void (again = true);
  busy = true;
  try {
    do {
      again = false;
      await Promise.all(panels.map(paint));
      await tell();
    } while (again);
  } catch (error) {
    byId("values").textContent = `A slice could not be shown: ${error.message}; is the command still running?`;
  } finally {
    busy = false;
  }
}

async function tell() {
  const [z, y, x] = state.point, axis = 0;
  const words = [];
  for (let k = 0; k < about.names.length; k++) {
    const codes = await slice(k, axis, z);
    words.push(`${about.names[k]} ${halves[codes[y * about.shape[2] + x]].toPrecision(3)}`);
  }
  byId("values").textContent = `z ${z}, y ${y}, x ${x}: ${words.join(", ")} 1/${about.unit}`;
  for (const panel of panels) {
    const { axis: along } = panel.plane;
    panel.slider.value = state.point[along];
    panel.says.textContent = `${LETTERS[along]} ${state.point[along]}`;
  }
}

function build() {
  const two = about.names.length > 1;
  const rows = !two ? [[0]] : state.mode === "side" ? [[state.left], [state.right]] : [[state.left, state.right]];
  const planes = about.shape[0] > 1 ? PLANES : PLANES.slice(0, 1);
  byId("planes").replaceChildren();
  byId("planes").className = planes.length === 1 ? "one" : "";
  panels = rows.flatMap((volumes, row) => planes.map((plane) => panelOf(plane, volumes, row)));
  byId("modes").hidden = !two;
  byId("swipe").disabled = state.mode !== "swipe";
}

function panelOf(plane, volumes, row) {
  const box = document.createElement("div");
  box.className = "panel";
  const canvas = document.createElement("canvas");
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", `${plane.name} slice of ${volumes.map((k) => about.names[k]).join(" and ")}`);
  const label = document.createElement("label"), slider = document.createElement("input");
  const says = document.createElement("output");
  Object.assign(slider, { type: "range", min: 0, max: about.shape[plane.axis] - 1, step: 1 });
  slider.setAttribute("aria-label", `${plane.name} slice`);
  slider.dataset.axis = plane.axis;
  slider.addEventListener("input", () => move(plane.axis, Number(slider.value)));
  label.append(plane.name, slider, says);
  box.append(canvas, label);
  const difference = state.mode === "difference" && volumes.length > 1;
  const names = difference ? [volumes.map((k) => about.names[k]).join(" − ")] : volumes.map((k) => about.names[k]);
  names.forEach((name, k) => {
    const tag = document.createElement("span");
    tag.className = k ? "name right" : "name";
    tag.textContent = name;
    box.append(tag);
  });
  byId("planes").append(box);
  const panel = { plane, canvas, slider, says, volumes, buffers: [] };
  listen(panel);
  return panel;
}

function listen(panel) {
  const { canvas, plane } = panel;
  const place = (event) => {
    const box = canvas.getBoundingClientRect();
    move(plane.across, Math.floor(((event.clientX - box.left) / box.width) * about.shape[plane.across]));
    move(plane.up, Math.floor((1 - (event.clientY - box.top) / box.height) * about.shape[plane.up]));
  };
  canvas.addEventListener("pointerdown", (event) => { canvas.setPointerCapture(event.pointerId); place(event); });
  canvas.addEventListener("pointermove", (event) => { if (event.buttons & 1) place(event); });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    move(plane.axis, state.point[plane.axis] + (event.deltaY > 0 ? -1 : 1));
  }, { passive: false });
}

function move(axis, index) {
  state.point[axis] = Math.max(0, Math.min(about.shape[axis] - 1, index));
  draw();
}

// Sliders of the window go with the square, for soft matter lies low beside metal.
const toValue = (slider) => about.range[0] + (Number(slider.value) / 1000) ** 2 * (about.range[1] - about.range[0]);
const toSlider = (value) => 1000 * Math.sqrt(Math.max(0, (value - about.range[0]) / (about.range[1] - about.range[0])));

function setWindow(low, high) {
  state.window = [Math.min(low, high), Math.max(low, high)];
  greys = greyTable(state.window);
  windows++;
  byId("lowsays").textContent = state.window[0].toPrecision(3);
  byId("highsays").textContent = `${state.window[1].toPrecision(3)} 1/${about.unit}`;
  draw();
}

function usualWindow() {
  byId("low").value = toSlider(about.window[0]);
  byId("high").value = toSlider(about.window[1]);
  setWindow(...about.window);
}

async function start() {
  about = await (await fetch("about.json")).json();
  halves = halfValues(about.scale);
  state.point = about.point.slice();
  const two = about.names.length > 1;
  // Before lies to the left: what stands beside the result.
  [state.left, state.right] = two ? [1, 0] : [0, 0];
  for (const side of ["left", "right"]) {
    byId(side).append(...about.names.map((name, k) => new Option(name, k, false, k === state[side])));
    byId(side).addEventListener("change", () => { state[side] = Number(byId(side).value); build(); draw(); });
  }
  document.querySelectorAll("input[name=mode]").forEach((radio) => radio.addEventListener("change", () => {
    state.mode = radio.value; build(); draw();
  }));
  byId("swipe").addEventListener("input", () => { state.swipe = Number(byId("swipe").value); draw(); });
  for (const id of ["low", "high"]) {
    byId(id).addEventListener("input", () => setWindow(toValue(byId("low")), toValue(byId("high"))));
  }
  byId("reset").addEventListener("click", usualWindow);
  addEventListener("resize", draw);
  build();
  usualWindow();
}

start().catch((error) => { byId("values").textContent = `The page could not be shown: ${error.message}`; });
