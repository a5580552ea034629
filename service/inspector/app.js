// The page: which scene, which controls, which draw.

import * as api from "./api.js";
import { drawBirdseye } from "./birdseye.js";
import { showCameras } from "./cameras.js";
import { byId, element } from "./dom.js";
import { asked, canBeJudged, feedbackOf, forgetFeedback, showFeedback } from "./feedback.js";
import { allowImagining, imagine, showImaginable } from "./imagination.js";
import { showDraw } from "./timeline.js";
import { averageError } from "./times.js";

const state = { view: null, draws: [], chosen: 0, judged: null, running: null, opened: new Map(), inputs: [], refines: false,
  thinking: ["adaptive", "always", "never"] };

const say = (text) => { byId("status").textContent = text; };

function complain(error) {
  const box = byId("problem");
  box.hidden = false;
  box.replaceChildren(element("strong", { textContent: error.title || "That did not work" }), ` ${error.message} `);
  if (error.requestId) box.append(element("code", { textContent: `request ${error.requestId}` }));
}

async function attempt(work) {
  byId("problem").hidden = true;
  try {
    await work();
  } catch (error) {
    if (error.name !== "AbortError") complain(error);
  }
}

function redraw() {
  if (state.view) drawBirdseye(state.view, state.draws, state.chosen, state.judged);
}

function forgetDraws() {
  clearTimeout(planSoon);
  state.running?.abort();
  state.running = null;
  state.draws = [];
  state.chosen = 0;
  forgetJudgement();
  byId("draws").hidden = true;
  byId("timeline").replaceChildren();
  byId("plan-title").textContent = "Plan";
  byId("link").hidden = true;
  for (const empty of document.querySelectorAll(".empty")) empty.hidden = false;
}

// Only of a bundled scene the service knows what happens next.
function forgetJudgement() {
  state.judged = null;
  forgetFeedback();
  byId("refine").hidden = true;
  byId("why").hidden = state.opened.has(byId("scene").value) || !canBeJudged(state.draws[state.chosen]);
}

async function judge() {
  const draw = state.draws[state.chosen];
  const answer = await api.feedback(byId("scene").value, ...asked(draw), state.running?.signal);
  if (state.draws[state.chosen] !== draw) return; // another one was chosen meanwhile
  showJudgement({ draft: answer[0], chosen: answer.at(-1) });
}

function showJudgement(judged) {
  state.judged = judged;
  byId("refine").hidden = !state.refines;
  showFeedback(judged);
  redraw();
}

// Plans the chosen draw again by the feedback that is shown; what comes of it is judged as the draw was.
async function refine() {
  const draw = state.draws[state.chosen];
  const { draft, chosen } = state.judged;
  const signal = state.running?.signal;
  byId("refine").disabled = true;
  say("Refining …");
  try {
    const body = await api.refine(given(), draw.trajectory, feedbackOf(chosen), { ...controls(), n: 1 }, signal);
    const [refinement] = body.draws;
    const [refined] = await api.feedback(byId("scene").value, ...asked(refinement), signal);
    if (state.draws[state.chosen] !== draw) return; // another one was chosen meanwhile
    showJudgement({ draft, chosen, refined, refinement });
    say(`Refined in ${body.timing.total_ms.toFixed(0)} ms, request ${body.request_id}`);
  } catch (error) {
    if (!signal?.aborted) say("No refinement.");
    throw error;
  } finally {
    byId("refine").disabled = false;
  }
}

function showView(view) {
  forgetDraws();
  state.view = view;
  showCameras(view.scene);
  showImaginable(view);
  byId("tags").replaceChildren(...view.tags.map((tag) => element("li", { textContent: tag.replaceAll("_", " ") })));
  byId("with-route").disabled = !view.scene.route;
  byId("with-tracks").disabled = !state.inputs.includes("tracks") || !view.tracks;
  redraw();
  say(`Scene ${view.scene.scene_id || "without a name"}: press Plan.`);
}

async function chooseScene() {
  const id = byId("scene").value;
  const view = state.opened.get(id) || await api.bundledScene(id);
  if (byId("scene").value === id) showView(view); // another one may have been chosen meanwhile
}

async function openFile(file) {
  say(`Reading ${file.name} …`);
  let views;
  try {
    views = await api.scenesOfFile(file);
  } catch (error) {
    say(`${file.name} was not opened.`);
    throw error;
  }
  if (!views.length) throw new Error(`${file.name} holds no scenes.`);
  const options = views.map((view, index) => {
    const id = `file:${file.name}:${index}`;
    state.opened.set(id, view);
    return element("option", { value: id, textContent: `${view.scene.scene_id || "scene"} (${file.name})` });
  });
  byId("scene").append(...options);
  byId("scene").value = options[0].value;
  showLink(null);
  showView(views[0]);
}

// A threshold decides at the branch only where there is one, and the model may decide at all.
const takesThreshold = () => byId("thinking").value === "adaptive" && state.thinking.includes("always");
const usesThreshold = () => takesThreshold() && byId("with-threshold").checked;

function showThreshold() {
  byId("with-threshold").disabled = !takesThreshold();
  byId("threshold").disabled = !usesThreshold();
  byId("threshold-value").textContent = usesThreshold() ? byId("threshold").valueAsNumber.toFixed(2)
    : takesThreshold() ? "sampled" : "unused";
}

let planSoon = 0;
function replan() {
  showThreshold();
  if (!state.draws.length) return;
  clearTimeout(planSoon);
  planSoon = setTimeout(() => attempt(state.again), 150); // while the slider moves, only its last place counts
}

function controls() {
  const deadline = byId("deadline").valueAsNumber;
  return {
    thinking: byId("thinking").value,
    think_threshold: usesThreshold() ? byId("threshold").valueAsNumber : null,
    deadline_ms: Number.isNaN(deadline) || byId("deadline").disabled ? null : deadline,
    n: byId("n").valueAsNumber,
    temperature: byId("temperature").valueAsNumber,
    seed: byId("seed").valueAsNumber,
  };
}

const given = () => ({
  ...state.view.scene,
  route: byId("with-route").checked ? state.view.scene.route : null,
  tracks: byId("with-tracks").checked && !byId("with-tracks").disabled ? state.view.tracks : null,
});

const plan = () => ask(plan, "Planning …", linkTo(LINKED), (signal) => api.plan(given(), controls(), signal));
const lookTwice = () => ask(lookTwice, "Looking twice …", linkTo([...LINKED, "proposal"]), (signal) =>
  api.reflect(given(), byId("proposal").value, controls(), signal));

async function ask(again, doing, link, request) {
  if (!state.view) return;
  state.again = again;
  state.running?.abort();
  const running = state.running = new AbortController();
  const buttons = [byId("plan"), byId("look-twice")];
  say(doing);
  for (const button of buttons) button.disabled = true;
  const began = performance.now();
  try {
    const body = await request(running.signal);
    showDraws(body);
    showLink(link);
    const { total_ms: total, engine_ms: engine } = body.timing;
    const deadline = body.deadline ? `, deadline ${body.deadline.met ? "met" : "missed"}` : "";
    say(`${body.draws.length} draws in ${total.toFixed(0)} ms (engine ${engine.toFixed(0)} ms, `
      + `with the network ${(performance.now() - began).toFixed(0)} ms)${deadline}, request ${body.request_id}`);
  } catch (error) {
    if (state.running === running) say("No plan.");
    throw error;
  } finally {
    if (state.running === running || !state.running) for (const button of buttons) button.disabled = false;
  }
}

// What decides a plan of a bundled scene stands behind the address's #, so that it can be sent to others.
const LINKED = ["scene", "thinking", "n", "temperature", "seed", "deadline"];
const LINKED_CHOICES = ["with-route", "with-tracks"];

// What is asked for now; null for a scene of a file, which others do not have.
function linkTo(ids) {
  if (state.opened.has(byId("scene").value)) return null;
  const values = new URLSearchParams(ids.map((id) => [id, byId(id).value]));
  for (const id of LINKED_CHOICES) values.set(id, byId(id).checked);
  if (usesThreshold()) values.set("threshold", byId("threshold").value);
  return values;
}

function showLink(values) {
  byId("link").hidden = values === null;
  history.replaceState(null, "", values === null ? location.pathname : `#${values}`);
  byId("link").href = location.href;
}

// Show the scene that the address names, and plan or look twice as it says; without a link, the scene that is chosen.
async function followLink() {
  const values = new URLSearchParams(location.hash.slice(1));
  const linked = values.get("scene");
  if (linked !== null && ![...byId("scene").options].some(({ value }) => value === linked)) {
    if (!state.view) await chooseScene();
    throw new Error("The link names a scene that is not here.");
  }
  for (const id of [...LINKED, "proposal"]) if (values.has(id)) byId(id).value = values.get(id);
  for (const id of LINKED_CHOICES) if (values.has(id)) byId(id).checked = values.get(id) === "true";
  if (linked !== null) byId("with-threshold").checked = values.has("threshold");
  if (values.has("threshold")) byId("threshold").value = values.get("threshold");
  showThreshold();
  if (linked !== null || !state.view) await chooseScene();
  if (linked !== null) await (values.has("proposal") ? lookTwice() : plan());
}

// Where the first plan would have led: under a deadline the service keeps that, otherwise it is asked for.
async function showDraft(draw) {
  if (draw.thinking === null || !draw.plan || draw.draft_trajectory || controls().deadline_ms !== null) return;
  const asked = { ...controls(), thinking: "never", think_threshold: null, prefill: draw.plan.text, n: 1 };
  const body = await api.plan(given(), asked, state.running?.signal);
  draw.draft_trajectory = body.draws[0].trajectory;
  redraw();
}

function errorOf(draw) {
  const metres = state.view.future && averageError(draw, state.view.future);
  return typeof metres === "number" ? `${metres.toFixed(2)} m` : "–";
}

const DISAGREES = {
  plan_trajectory: ["plan ≠ path", "the trajectory does something else than the plan it follows"],
  reason_change: ["words ≠ plan", "the revised plan does not change as the reasoning asks for"],
};

function showDraws({ draws, agreed = null, deadline = null }) {
  Object.assign(state, { draws, agreed, deadline });
  byId("draws").hidden = draws.length === 0;
  for (const empty of document.querySelectorAll(".empty")) empty.hidden = true;
  byId("draws").tBodies[0].replaceChildren(...draws.map(drawRow));
  if (draws.length) choose(agreed ?? 0);
}

function drawRow(draw, index) {
  const radio = element("input", { type: "radio", name: "draw", value: index });
  radio.addEventListener("change", () => choose(index));
  const thinks = draw.thinking !== null || draw.revised_plan !== null;
  const branch = element("span", { className: `branch${thinks ? " think" : ""}`, textContent: thinks ? "second look" : "direct" });
  const tokens = Object.values(draw.tokens).reduce((sum, count) => sum + count, 0);
  const row = element("tr", {},
    element("td", {}, element("label", {}, radio, `draw ${draw.index}`),
      index === state.agreed ? element("span", { className: "agreed", textContent: "agreed", title: "nearest to all other draws: the one to drive by" }) : ""),
    element("td", {}, draw.branch === null ? "–" : branch,
      ...draw.disagreements.map((parts) => element("span", { className: "disagrees", textContent: DISAGREES[parts]?.[0] ?? parts, title: DISAGREES[parts]?.[1] ?? "" }))),
    element("td", {}, draw.think_probability === null ? "–" : probability(draw.think_probability)),
    element("td", {}, ...deadlineOf(draw)),
    element("td", { className: "number", textContent: tokens }),
    element("td", { className: "number", textContent: errorOf(draw) }));
  row.addEventListener("click", () => choose(index));
  return row;
}

// Whether the answer was in time, and what that took of the draw's second look.
function deadlineOf(draw) {
  if (!state.deadline) return ["–"];
  const told = [state.deadline.met ? "met" : "missed"];
  if (draw.cut) told.push(" ", element("span", { className: "cut", textContent: draw.cut, title: "what the deadline did to the second look" }));
  return told;
}

function probability(value) {
  const bar = element("i");
  bar.style.width = `${100 * value}%`;
  return element("span", { className: "probability" },
    element("span", {}, bar), element("span", { textContent: value.toFixed(2) }));
}

function choose(index) {
  state.chosen = index;
  [...byId("draws").tBodies[0].rows].forEach((row, position) => {
    row.classList.toggle("is-chosen", position === index);
    row.querySelector("input").checked = position === index;
  });
  byId("plan-title").textContent = `Plan of draw ${state.draws[index].index}`;
  showDraw(state.draws[index]);
  forgetJudgement();
  if (state.draws[index].plan) byId("proposal").value = state.draws[index].plan.text;
  redraw();
  attempt(() => showDraft(state.draws[index]));
}

function listen() {
  byId("scene").addEventListener("change", () => {
    showLink(null);
    attempt(chooseScene);
  });
  byId("controls").addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(plan);
  });
  byId("look").addEventListener("submit", (event) => {
    event.preventDefault();
    attempt(lookTwice);
  });
  byId("imagine").addEventListener("click", () => attempt(() => imagine(given(), controls().seed)));
  byId("why").addEventListener("click", () => attempt(judge));
  byId("refine").addEventListener("click", () => attempt(refine));
  byId("thinking").addEventListener("change", showThreshold);
  byId("with-threshold").addEventListener("change", replan);
  byId("threshold").addEventListener("input", replan);
  byId("file").addEventListener("change", (event) => {
    const [file] = event.target.files;
    event.target.value = ""; // the same file can be opened again
    if (file) attempt(() => openFile(file));
  });
  document.addEventListener("dragover", (event) => {
    event.preventDefault();
    byId("drop-hint").hidden = false;
  });
  document.addEventListener("dragleave", (event) => {
    if (!event.relatedTarget) byId("drop-hint").hidden = true;
  });
  document.addEventListener("drop", (event) => {
    event.preventDefault();
    byId("drop-hint").hidden = true;
    const [file] = event.dataTransfer.files;
    if (file) attempt(() => openFile(file));
  });
  new ResizeObserver(redraw).observe(byId("birdseye"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
}

async function begin() {
  const [scenes] = await Promise.all([api.sceneList(), showModel()]); // the model says what it takes
  byId("scene").replaceChildren(...scenes.map(({ scene_id: id, tags }) =>
    element("option", { value: id, textContent: tags.length ? `${id} · ${tags.join(", ").replaceAll("_", " ")}` : id })));
  if (!scenes.length) return;
  addEventListener("hashchange", () => attempt(followLink)); // a link pasted into the page that is open
  await followLink();
}

async function showModel() {
  const [card] = await api.models();
  state.inputs = card.inputs;
  state.refines = card.refines.length > 0;
  byId("deadline").disabled = !card.deadlines;
  if (!card.deadlines) byId("deadline").value = "";
  byId("look").hidden = card.reflects.length === 0;
  state.thinking = card.thinking[card.formats[0]] ?? state.thinking;
  for (const option of byId("thinking").options) option.disabled = !state.thinking.includes(option.value);
  showThreshold();
  allowImagining(card);
  byId("model").textContent = `${card.name} ${card.revision} · ${card.engine} · ${card.cameras.length} cameras`;
}

listen();
showThreshold();
attempt(begin);
