// What a camera sees now, what the model imagines half a second later, and what really came.

import * as api from "./api.js";
import { source } from "./cameras.js";
import { byId, element } from "./dom.js";

const CODES = 98;
const CAMERAS = ["front_wide_120", "front_tele_30", "front_left", "front", "front_right", "back_left", "back", "back_right"];

let view = null;
let running = null;

// A model that cannot imagine, or cannot paint, has no such section.
export function allowImagining(card) {
  byId("imagine-panel").hidden = !(card.paints && card.imagines.length);
  byId("imagine-camera").replaceChildren(...CAMERAS.map((camera) =>
    element("option", { value: camera, textContent: camera.replaceAll("_", " ") })));
}

export function showImaginable(shown) {
  view = shown;
  const known = view.next_images?.[0] ?? view.scene.clips[0];
  byId("imagine-camera").value = known.camera;
  forget();
}

function forget() {
  running?.abort();
  running = null;
  byId("imagine").disabled = false;
  byId("imagine-progress").textContent = "";
  byId("foreseen").textContent = "";
  show(null);
}

function show(imagined) {
  const camera = byId("imagine-camera").value;
  const clip = view?.scene.clips.find((each) => each.camera === camera);
  const came = view?.next_images?.find((each) => each.camera === camera);
  const pictures = [["now", clip?.images.at(-1)], ["imagined", imagined], ["what came", came?.image]];
  byId("imagined").replaceChildren(...pictures.filter(([, image]) => image).map(([caption, image]) =>
    element("figure", {},
      element("img", { src: source(image), alt: `${camera.replaceAll("_", " ")}, ${caption}` }),
      element("figcaption", { textContent: caption }))));
}

const TELLS = {
  perception: ({ perception: { objects } }) => { progress(`perceives ${objects.length} around`); },
  prediction: ({ prediction: { x_m: x, y_m: y, direction } }) => {
    byId("foreseen").textContent = `The ego will be ${metres(x)} ahead, ${metres(Math.abs(y))} to the `
      + `${y < 0 ? "right" : "left"}: ${direction}.`;
  },
  codes: ({ written }) => { progress(`${written} of ${CODES} codes`); },
  picture: ({ image }) => { show(image); },
  done: ({ timing }) => { progress(`in ${timing.total_ms.toFixed(0)} ms`); },
};

const metres = (value) => `${value.toFixed(1)} m`;
const progress = (text) => { byId("imagine-progress").textContent = text; };

export async function imagine(scene, seed) {
  forget();
  const mine = running = new AbortController();
  byId("imagine").disabled = true;
  progress("looking …");
  try {
    const asked = { scene, camera: byId("imagine-camera").value, controls: { n: 1, seed } };
    await api.imagine(asked, (name, data) => { if (running === mine) TELLS[name]?.(data); }, mine.signal);
  } catch (error) {
    if (running === mine) progress("No picture.");
    throw error;
  } finally {
    if (running === mine) byId("imagine").disabled = false;
  }
}

byId("imagine-camera").addEventListener("change", forget);
