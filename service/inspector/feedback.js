// Whether a draw is right by its score, and why not: sub-scores as bars, a teacher's sections.

import { byId, element } from "./dom.js";

const SECTIONS = {
  meta_action: "Meta action analysis",
  think_process: "Think process analysis",
  safety_failure: "Safety failure",
  efficiency_failure: "Efficiency failure",
  correction: "Actionable correction",
};

// Only trajectories as they are scored, and refined: 64 poses at 10 Hz, which have no times of their own, or 8 half a
// second apart.
export function canBeJudged(draw) {
  const times = draw?.times_s;
  if (times) return times.length === 8 && times.every((seconds, row) => seconds === (row + 1) / 2);
  return Boolean(draw) && draw.trajectory.length === 64;
}

// What to judge of a draw: where its first plan led, where that is known, and where it leads.
export function asked(draw) {
  const of = (plan, think) => ({ plan: plan?.text ?? null, think });
  const trajectories = [draw.trajectory];
  const said = [of(draw.revised_plan ?? draw.plan, draw.thinking)];
  if (draw.draft_trajectory) {
    trajectories.unshift(draw.draft_trajectory);
    said.unshift(of(draw.plan, null));
  }
  return [trajectories, said];
}

// Feedback as a refinement takes it; sections name the plan that they were written for.
export const feedbackOf = (plan) => (plan.sections ? { ...plan.sections, plan_id: plan.plan_id } : plan.text);

export function showFeedback({ draft, chosen, refined = null, refinement = null }) {
  const steps = draft === chosen ? [[chosen, "The plan"]] : [[draft, "First plan"], [chosen, "After the second look"]];
  if (refined) steps.push([refined, "The refinement", refinement.thinking]);
  const compared = steps.slice(-2).map(([plan]) => plan);
  const parts = steps.flatMap(([plan, whose, thinking], place) => told(plan, whose, thinking, place > 0));
  byId("feedback").replaceChildren(bars(compared), ...parts);
}

export const forgetFeedback = () => byId("feedback").replaceChildren();

const scoreOf = (plan) => (plan.score === null ? `partial score ${number(plan.partial_score)}` : `score ${number(plan.score)}`);
const number = (value) => (value === null ? "not known" : value.toFixed(2));
const look = (plan, isRefined) => (plan.correct ? (isRefined ? "refined" : "") : "wrong");

// A verdict, the thoughts that led to the plan where they are shown nowhere else, and what is said of it.
function told(plan, whose, thinking, isRefined) {
  const heading = element("h3", {
    className: look(plan, isRefined),
    textContent: `${whose} is ${plan.correct ? "correct" : "wrong"}: ${scoreOf(plan)}`,
  });
  const parts = thinking ? [heading, element("blockquote", { textContent: thinking })] : [heading];
  if (!plan.sections) return [...parts, element("p", { textContent: plan.text })];
  return [...parts, ...Object.entries(SECTIONS).map(([field, title]) =>
    element("p", {}, element("strong", { textContent: `${title}: ` }), plan.sections[field]))];
}

// A row for each sub-score: before a second look or refinement above, after it below.
function bars(compared) {
  const rows = Object.keys(compared.at(-1).sub_scores).flatMap((name) => [
    element("dt", { textContent: name.replaceAll("_", " ") }),
    element("dd", { className: "bars" }, ...compared.map((plan, place) => bar(plan, plan.sub_scores[name], place > 0))),
    element("dd", { textContent: compared.map((plan) => number(plan.sub_scores[name])).join(" \u2192 ") }),
  ]);
  return element("dl", { className: "scores" }, ...rows);
}

function bar(plan, value, isRefined) {
  const fill = element("i");
  fill.style.width = `${100 * (value ?? 0)}%`;
  const row = element("span", { className: look(plan, isRefined) }, fill);
  row.setAttribute("aria-hidden", "true");
  return row;
}
