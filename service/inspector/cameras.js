// The camera clips: four frames each, all cameras in step.

import { byId, element } from "./dom.js";

const FRAME_MS = 500; // clips are recorded at 2 Hz
const TYPES = [["/9j/", "jpeg"], ["iVBOR", "png"], ["UklGR", "webp"]];

let clips = [];
let timer = 0;

export function source(base64) {
  const [, type] = TYPES.find(([start]) => base64.startsWith(start)) || ["", "jpeg"];
  return `data:image/${type};base64,${base64}`;
}

export function showCameras(scene) {
  stop();
  clips = scene.clips.map((clip) => ({
    sources: clip.images.map(source),
    image: element("img", { alt: "" }),
    camera: clip.camera,
  }));
  byId("clips").replaceChildren(...clips.map(({ image, camera }) =>
    element("figure", {}, image, element("figcaption", { textContent: String(camera).replaceAll("_", " ") }))));
  const last = Math.max(...clips.map((clip) => clip.sources.length)) - 1;
  byId("frame").max = last;
  show(last);
}

function show(frame) {
  const slider = byId("frame");
  slider.value = frame;
  const seconds = (Number(frame) - Number(slider.max)) * FRAME_MS / 1000;
  const when = seconds === 0 ? "now" : `${seconds.toFixed(1).replace("-", "−")} s`;
  byId("frame-time").textContent = when;
  slider.setAttribute("aria-valuetext", when);
  for (const { image, sources, camera } of clips) {
    image.src = sources[Math.min(frame, sources.length - 1)];
    image.alt = `${camera}, ${when}`;
  }
}

function stop() {
  clearInterval(timer);
  timer = 0;
  byId("play").textContent = "Play";
  byId("play").setAttribute("aria-pressed", "false");
}

function toggle() {
  if (timer) return stop();
  const slider = byId("frame");
  timer = setInterval(() => show((Number(slider.value) + 1) % (Number(slider.max) + 1)), FRAME_MS);
  byId("play").textContent = "Pause";
  byId("play").setAttribute("aria-pressed", "true");
}

byId("play").addEventListener("click", toggle);
byId("frame").addEventListener("input", (event) => {
  stop();
  show(Number(event.target.value));
});
