// What the chosen draw says: plans as tracks over time, the reasoning, sections of its own, tokens per section.

import { byId, element } from "./dom.js";

const HORIZON_S = 6.4;
const MOST_NUMBERS = 20;
const GROUPS = ["longitudinal", "lateral", "lane"];
const LOOK = {
  "Accelerate": "go", "Decelerate": "slow", "Wait": "stop", "Reverse": "back",
  "Left Turn": "left", "Left Lane Change": "left", "Right Turn": "right", "Right Lane Change": "right",
};

const percent = (seconds) => `${100 * seconds / HORIZON_S}%`;

export function showDraw(draw) {
  const parts = [];
  if (draw.plan) parts.push(element("h3", { textContent: "First plan" }), tracks(draw.plan, null));
  if (draw.thinking !== null) {
    const title = draw.branch === null ? "Thoughts" : "Second look";
    parts.push(element("h3", { textContent: title }), element("blockquote", { textContent: draw.thinking }));
  }
  if (draw.revised_plan) {
    parts.push(element("h3", { textContent: "Revised plan" }), tracks(draw.revised_plan, draw.plan));
  }
  for (const section of draw.sections ?? []) {
    const text = said(section.values).trim();
    if (text) {
      parts.push(
        element("h3", { textContent: section.name.replaceAll("_", " ") }),
        element("p", { className: "said", textContent: text }),
      );
    }
  }
  if (!parts.length) {
    parts.push(element("p", { className: "empty", textContent: "This response format says nothing but its trajectory." }));
  }
  const chips = Object.entries(draw.tokens).map(([section, count]) =>
    element("li", { textContent: `${section.replaceAll("_", " ")} ${count}` }));
  parts.push(
    element("h3", { textContent: "Tokens per section" }),
    element("ul", { className: "chips", id: "tokens" }, ...chips),
  );
  const plan = draw.revised_plan || draw.plan;
  if (plan) {
    const text = element("pre", { textContent: plan.text, tabIndex: 0 });
    parts.push(element("details", {}, element("summary", { textContent: "Plan as text" }), text));
  }
  byId("timeline").replaceChildren(...parts);
}

// A value by its kind: words and numbers as they are, several after each other, records in a line each, with the
// names of their values. Long rows of numbers, such as codes, are only counted.
function said(value) {
  if (Array.isArray(value)) {
    if (value.length > MOST_NUMBERS && value.every(Number.isFinite)) return `${value.length} numbers`;
    return value.map((each) => `${said(each)}${ofRecords(each) ? "\n" : " "}`).join("").trimEnd();
  }
  if (value === null || typeof value !== "object") return String(value);
  return Object.entries(value).map(([name, inner]) => `${name.replaceAll("_", " ")} ${said(inner)}`).join(", ");
}

function ofRecords(value) {
  return Array.isArray(value) ? value.some(ofRecords) : value !== null && typeof value === "object";
}

// Segments that differ from the plan before are marked.
function tracks(plan, before) {
  const rows = GROUPS.filter((group) => plan.tracks[group]).flatMap((group) => [
    element("span", { textContent: group }),
    track(group, plan.tracks[group], before && before.tracks[group]),
  ]);
  return element("div", { className: "tracks" }, ...rows, element("span"), axis());
}

function track(group, segments, before) {
  const items = segments.map((segment) => {
    const when = `${segment.start_s.toFixed(1)}–${segment.end_s.toFixed(1)} s`;
    const item = element("li", { textContent: segment.word, title: `${segment.word}, ${when}` });
    item.className = LOOK[segment.word] || "";
    item.style.left = percent(segment.start_s);
    item.style.width = percent(segment.end_s - segment.start_s);
    item.classList.toggle("changed", Boolean(before) && !same(segment, before));
    item.setAttribute("aria-label", `${when}: ${segment.word}`);
    return item;
  });
  const list = element("ol", { className: "track" }, ...items);
  list.setAttribute("aria-label", `${group} track`);
  return list;
}

const same = (segment, before) => before.some((other) =>
  other.word === segment.word && other.start_s <= segment.start_s && other.end_s >= segment.end_s);

function axis() {
  const marks = [0, 1, 2, 3, 4, 5, 6.4].map((seconds) => {
    const mark = element("span", { textContent: seconds === 0 ? "0 s" : String(seconds) });
    mark.style.left = percent(seconds);
    return mark;
  });
  const line = element("div", { className: "axis" }, ...marks);
  line.setAttribute("aria-hidden", "true");
  return line;
}
