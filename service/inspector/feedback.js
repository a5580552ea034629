// Whether a draw is right by its score, and why not: sub-scores as bars, a teacher's sections.

import { byId, element } from "./dom.js";

const SECTIONS = {
  meta_action: "Meta action analysis",
  think_process: "Think process analysis",
  safety_failure: "Safety failure",
  efficiency_failure: "Efficiency failure",
  correction: "Actionable correction",
};

// Only trajectories as they are scored: 64 poses at 10 Hz, which have no times of their own.
export const canBeJudged = (draw) => Boolean(draw) && !draw.times_s && draw.trajectory.length === 64;

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

export function showFeedback(judged) {
  const { draft, chosen } = judged;
  const before = draft === chosen ? null : draft;
  const parts = [bars(before, chosen)];
  if (before) parts.push(...told(before, "First plan"), ...told(chosen, "After the second look"));
  else parts.push(...told(chosen, "The plan"));
  byId("feedback").replaceChildren(...parts);
}

export const forgetFeedback = () => byId("feedback").replaceChildren();

const scoreOf = (plan) => (plan.score === null ? `partial score ${number(plan.partial_score)}` : `score ${number(plan.score)}`);
const number = (value) => (value === null ? "not known" : value.toFixed(2));
const look = (plan, isRefined) => (plan.correct ? (isRefined ? "refined" : "") : "wrong");

function told(plan, whose) {
  const heading = element("h3", {
    className: plan.correct ? "" : "wrong",
    textContent: `${whose} is ${plan.correct ? "correct" : "wrong"}: ${scoreOf(plan)}`,
  });
  if (!plan.sections) return [heading, element("p", { textContent: plan.text })];
  return [heading, ...Object.entries(SECTIONS).map(([field, title]) =>
    element("p", {}, element("strong", { textContent: `${title}: ` }), plan.sections[field]))];
}

// A row for each sub-score: before the second look above, after it below.
function bars(before, chosen) {
  const rows = Object.entries(chosen.sub_scores).flatMap(([name, value]) => {
    const both = before ? [[before, before.sub_scores[name], false], [chosen, value, true]] : [[chosen, value, false]];
    const label = both.map(([, each]) => number(each)).join(" \u2192 ");
    return [
      element("dt", { textContent: name.replaceAll("_", " ") }),
      element("dd", { className: "bars" }, ...both.map(([plan, each, isRefined]) => bar(plan, each, isRefined))),
      element("dd", { textContent: label }),
    ];
  });
  return element("dl", { className: "scores" }, ...rows);
}

function bar(plan, value, isRefined) {
  const fill = element("i");
  fill.style.width = `${100 * (value ?? 0)}%`;
  const row = element("span", { className: look(plan, isRefined) }, fill);
  row.setAttribute("aria-hidden", "true");
  return row;
}
