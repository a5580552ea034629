// The scene from above: x forward is up, y left is left, metres.

import { byId } from "./dom.js";
import { timesOf } from "./times.js";

const EGO = { length_m: 4.51, width_m: 1.85 };
const BEHIND_M = 14;
const BESIDE_M = 15; // at least, to either side; farther where somebody turns
const AROUND_M = 4; // what lies beside the outermost point of a trajectory
const NOW = 15; // row of the present in an agent's track
const SECOND = 10; // rows
const THICKNESS = { expert: 10, draft: 7, refinement: 4 }; // px: where they are the same way, all three show

// Of a draw that was judged, what is wrong is red, what was driven green, and what a second look or a refinement made of
// it blue. A refinement stays blue where it is wrong itself: feedback tells that, and red it would hide the draft.
export function drawBirdseye(view, draws, chosen, judged = null) {
  const canvas = byId("birdseye");
  const ratio = window.devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const pen = canvas.getContext("2d");
  pen.scale(ratio, ratio);
  const style = getComputedStyle(document.documentElement);
  const color = (name) => style.getPropertyValue(`--${name}`).trim();

  const refinement = judged?.refinement;
  const ways = [view.future, refinement?.trajectory, ...draws.flatMap((draw) => [draw.trajectory, draw.draft_trajectory])]
    .filter(Boolean).flat();
  const ahead = Math.max(35, ...ways.map(([x]) => x)) + 10;
  const left = Math.max(BESIDE_M, ...ways.map(([, y]) => y + AROUND_M));
  const right = Math.max(BESIDE_M, ...ways.map(([, y]) => AROUND_M - y));
  const scale = Math.min(height / (ahead + BEHIND_M), width / (left + right));
  const origin = [width * left / (left + right), height - BEHIND_M * scale];
  const at = ([x, y]) => [origin[0] - y * scale, origin[1] - x * scale];
  const map = { pen, color, scale, at, width, height };

  road(map, view);
  distances(map);
  if (view.scene.route) line(map, view.scene.route, "route", 3, [2, 6]);
  line(map, view.scene.history, "ego", 2, [3, 4], 0.5);
  for (const agent of view.agents) agentFuture(map, agent);
  for (const agent of view.agents) if (agent.poses[NOW]) box(map, agent.poses[NOW], agent, tint(agent), 1);
  draws.forEach((draw, index) => index !== chosen && line(map, start(draw.trajectory), "draw", 2, [], 0.5));
  const thickness = refinement ? THICKNESS.expert : judged ? 3.5 : 2.5;
  if (view.future) line(map, start(view.future), "expert", thickness, judged ? [] : [7, 5]);
  const draft = draws[chosen]?.draft_trajectory;
  if (draft) line(map, start(draft), judged && !judged.draft.correct ? "wrong" : "draft", 3, judged ? [] : [9, 5]);
  const isWrong = judged && !judged.chosen.correct;
  if (refinement) {
    line(map, start(draws[chosen].trajectory), isWrong ? "wrong" : "draft", THICKNESS.draft);
    dotted(map, refinement, "refined", THICKNESS.refinement);
  } else if (draws[chosen]) dotted(map, draws[chosen], isWrong ? "wrong" : draft ? "refined" : "chosen");
  box(map, [0, 0, 0], EGO, "ego", 1);
  canvas.setAttribute("aria-label", describe(view, draws, chosen, judged));
}

const start = (rows) => [[0, 0], ...rows];
const tint = (agent) => (agent.kind === "pedestrian" ? "walker" : "agent");

function path({ pen, at }, rows) {
  pen.beginPath();
  rows.forEach((row, index) => pen[index ? "lineTo" : "moveTo"](...at(row)));
}

function line(map, rows, name, width, dash = [], alpha = 1) {
  const { pen } = map;
  path(map, rows);
  Object.assign(pen, { strokeStyle: map.color(name), lineWidth: width, globalAlpha: alpha, lineJoin: "round", lineCap: "round" });
  pen.setLineDash(dash);
  pen.stroke();
  pen.setLineDash([]);
  pen.globalAlpha = 1;
}

function road(map, view) {
  const { pen, at } = map;
  pen.beginPath();
  for (const ring of view.drivable) {
    ring.forEach((point, index) => pen[index ? "lineTo" : "moveTo"](...at(point)));
    pen.closePath();
  }
  pen.fillStyle = map.color("road");
  pen.fill("evenodd"); // holes are rings too
  for (const lane of view.lane_lines) line(map, lane, "lane", 1, [1, 5]);
}

function distances({ pen, color, at, width, height }) {
  Object.assign(pen, { fillStyle: color("quiet"), font: "11px system-ui, sans-serif", textBaseline: "middle" });
  for (let metres = 0; at([metres, 0])[1] > 12; metres += 20) {
    const y = at([metres, 0])[1];
    if (y < height) pen.fillText(`${metres} m`, 8, y);
    pen.fillRect(0, y, 5, 1);
    pen.fillRect(width - 5, y, 5, 1);
  }
}

function box({ pen, color, at, scale }, [x, y, heading], { length_m: length, width_m: width }, name, alpha) {
  pen.save();
  pen.translate(...at([x, y]));
  pen.rotate(-heading);
  Object.assign(pen, { globalAlpha: alpha, fillStyle: color(name) });
  const w = Math.max(width * scale, 4);
  const l = Math.max(length * scale, 4);
  pen.beginPath();
  pen.roundRect(-w / 2, -l / 2, w, l, Math.min(3, w / 4));
  pen.fill();
  if (length > 2 && alpha === 1) { // the front
    pen.fillStyle = color("road");
    pen.fillRect(-w * 0.36, -l * 0.28, w * 0.72, l * 0.13);
  }
  pen.restore();
}

function agentFuture(map, agent) {
  const future = agent.poses.slice(NOW).filter(Boolean);
  const moves = future.length > 1 && Math.hypot(future.at(-1)[0] - future[0][0], future.at(-1)[1] - future[0][1]) > 0.5;
  if (!moves) return;
  line(map, future, tint(agent), 1.5, [], 0.35);
  for (let row = NOW + SECOND; row < agent.poses.length; row += SECOND) {
    if (agent.poses[row]) box(map, agent.poses[row], agent, tint(agent), 0.32 - 0.035 * (row - NOW) / SECOND);
  }
}

// With a dot at every whole second at which it has a pose.
function dotted(map, draw, name, thickness = 3.5) {
  const { pen, at, color } = map;
  line(map, start(draw.trajectory), name, thickness);
  timesOf(draw).forEach((seconds, row) => {
    if (Math.abs(seconds - Math.round(seconds)) > 1e-6) return;
    pen.beginPath();
    pen.arc(...at(draw.trajectory[row]), 3.5, 0, 2 * Math.PI);
    Object.assign(pen, { fillStyle: color("panel"), strokeStyle: color(name), lineWidth: 2 });
    pen.fill();
    pen.stroke();
  });
}

function describe(view, draws, chosen, judged) {
  const parts = [`The scene from above with ${view.agents.length} agents`];
  if (draws[chosen]) {
    const [x, y] = draws[chosen].trajectory.at(-1);
    const side = y >= 0 ? "left" : "right";
    parts.push(`${draws.length} draws; the chosen one ends ${x.toFixed(0)} m ahead and ${Math.abs(y).toFixed(1)} m to the ${side}`);
    const draft = draws[chosen].draft_trajectory;
    if (draft) {
      const [dx, dy] = draft.at(-1);
      parts.push(`its draft ended ${Math.hypot(dx - x, dy - y).toFixed(1)} m from there`);
    }
  }
  const verdict = (plan) => (plan.correct ? "correct" : "wrong");
  if (judged) parts.push(`by its score the chosen one is ${verdict(judged.chosen)}`);
  if (judged?.refinement) {
    const [x] = judged.refinement.trajectory.at(-1);
    parts.push(`its refinement ends ${x.toFixed(0)} m ahead and is ${verdict(judged.refined)}`);
  }
  return parts.join("; ");
}
