// What the page asks the service for. Errors carry the problem document.

export class Problem extends Error {
  constructor(document) {
    super(document.detail || document.title);
    this.title = document.title;
    this.requestId = document.request_id || "";
  }
}

async function answer(response) {
  const body = await response.json().catch(() => null);
  if (response.ok && body) return body;
  throw new Problem(body || { title: `The service answered ${response.status}`, detail: "without a reason" });
}

const get = (path) => fetch(path).then(answer);

export const models = () => get("/v1/models").then((body) => body.models);
export const sceneList = () => get("/v1/scenes").then((body) => body.scenes);
export const bundledScene = (id) => get(`/v1/scenes/${encodeURIComponent(id)}`);

export function plan(scene, controls, signal) {
  return fetch("/v1/plan", {
    method: "POST",
    headers: { "Content-Type": "application/json" },
    body: JSON.stringify({ scene, controls }),
    signal,
  }).then(answer);
}

// A labelled scene per scene in the file. Parquet is read by the service, JSON here.
export async function scenesOfFile(file) {
  if (!file.name.toLowerCase().endsWith(".json")) {
    const body = await answer(await fetch("/v1/scenes:read", { method: "POST", body: file }));
    return body.scenes;
  }
  let content;
  try {
    content = JSON.parse(await file.text());
  } catch (error) {
    throw new Problem({ title: `${file.name} is not JSON`, detail: error.message });
  }
  return [labelled(content, file.name)];
}

// Accepts what the wire knows: a labelled scene, a plan request, or a bare scene.
function labelled(content, name) {
  const scene = content && content.scene ? content.scene : content;
  const shaped = scene && Array.isArray(scene.clips) && scene.clips.length && Array.isArray(scene.history)
    && scene.clips.every((clip) => Array.isArray(clip.images) && clip.images.length);
  if (!shaped) {
    throw new Problem({ title: `${name} holds no scene`, detail: "a scene has clips with images, and a history" });
  }
  const known = content.scene ? content : {};
  return {
    scene,
    future: known.future || null,
    agents: known.agents || [],
    drivable: known.drivable || [],
    lane_lines: known.lane_lines || [],
    tags: known.tags || [],
  };
}
