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

const unanswered = (error) => (error.name === "AbortError" ? error
  : new Problem({ title: "The service does not answer", detail: "Is it still running? Then try again." }));

async function ask(path, options) {
  let response;
  try {
    response = await fetch(path, options);
  } catch (error) {
    throw unanswered(error);
  }
  return answer(response);
}

const get = (path) => ask(path);
const post = (path, document, signal) => ask(path, {
  method: "POST",
  headers: { "Content-Type": "application/json" },
  body: JSON.stringify(document),
  signal,
});

export const models = () => get("/v1/models").then((body) => body.models);
export const sceneList = () => get("/v1/scenes").then((body) => body.scenes);
export const bundledScene = (id) => get(`/v1/scenes/${encodeURIComponent(id)}`);

export const plan = (scene, controls, signal) => post("/v1/plan", { scene, controls }, signal);

// Looks at a plan, as text, answered in the shape of planned draws.
export async function reflect(scene, text, controls, signal) {
  const body = await post("/v1/reflect", { scene, plan: text, controls }, signal);
  const draws = body.draws.map((draw) => ({
    ...draw,
    plan: body.plan,
    think_probability: body.think_probability,
  }));
  return { ...body, draws };
}

// One imagined picture, told of as it is written: names of events with their data.
export async function imagine(asked, tell, signal) {
  let response;
  try {
    response = await fetch("/v1/imagine", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ ...asked, stream: true }),
      signal,
    });
  } catch (error) {
    throw unanswered(error);
  }
  if (!response.ok) return answer(response);
  let text = "";
  const reader = response.body.pipeThrough(new TextDecoderStream()).getReader();
  for (let part = await reader.read(); !part.done; part = await reader.read()) {
    const events = (text + part.value).split("\n\n");
    text = events.pop(); // not whole yet
    for (const event of events) {
      const fields = Object.fromEntries(event.split("\n").map((line) => line.split(/: (.*)/s, 2)));
      const data = JSON.parse(fields.data);
      if (fields.event === "error") throw new Problem(data);
      tell(fields.event, data);
    }
  }
  return null;
}

// Trajectories of a bundled scene, judged: rows of x, y, z, heading in, a verdict with facts for each out.
export const feedback = (sceneId, trajectories, said, signal) => post("/v1/feedback", {
  scene_id: sceneId,
  trajectories: trajectories.map((rows) => rows.map(([x, y, , heading]) => [x, y, heading])),
  said,
}, signal).then((body) => body.feedback);

// A draft that is planned again by feedback on it: a text, or five sections with the plan that they are of.
export const refine = (scene, draft, feedback, controls, signal) =>
  post("/v1/refine", { scene, draft, feedback, controls }, signal);

// A labelled scene per scene in the file. Parquet is read by the service, JSON here.
export async function scenesOfFile(file) {
  if (!file.name.toLowerCase().endsWith(".json")) {
    const body = await ask("/v1/scenes:read", { method: "POST", body: file });
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
    tracks: scene.tracks || known.tracks || null,
    next_images: known.next_images || [],
  };
}
