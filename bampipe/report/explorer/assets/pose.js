// The pose at the cursor: an arm from the side and from above, other axes as scales.

const pose = { channels: [] };
const BODY_PX = 230;
const MARGIN_PX = 22;
const POSES = 200;

const rotate = (m, v) => m.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
const multiply = (a, b) => a.map((row) => [0, 1, 2].map((k) => row[0] * b[0][k] + row[1] * b[1][k] + row[2] * b[2][k]));
const plus = (a, b, factor = 1) => a.map((value, k) => value + factor * b[k]);

/** Rotation by an angle about a unit vector. */
function about([x, y, z], angle) {
  const [c, s] = [Math.cos(angle), Math.sin(angle)];
  const t = 1 - c;
  return [
    [t * x * x + c, t * x * y - s * z, t * x * z + s * y],
    [t * x * y + s * z, t * y * y + c, t * y * z - s * x],
    [t * x * z - s * y, t * y * z + s * x, t * z * z + c],
  ];
}

/** Ends of the links in the frame of the base: from the joint before to the joint and to its end. */
function placeJoints(positions) {
  const known = new Map([["", { turn: about([0, 0, 1], 0), at: [0, 0, 0] }]]);
  const carrying = new Set(content.joints.map((joint) => joint.after));
  return content.joints.map((joint) => {
    const before = known.get(joint.after ?? "");
    const [roll, pitch, yaw] = joint.rotation ?? [0, 0, 0];
    const drawn = multiply(about([0, 0, 1], yaw), multiply(about([0, 1, 0], pitch), about([1, 0, 0], roll)));
    const given = joint.axis ?? [0, 0, 1];
    const axis = given.map((value) => value / Math.hypot(...given));
    const q = joint.follows ? (joint.zero ?? 0) + (joint.ratio ?? 1) * (positions[joint.follows] ?? 0) : (positions[joint.name] ?? 0);
    const slides = joint.kind === "prismatic";
    let turn = multiply(before.turn, drawn);
    let at = plus(before.at, rotate(before.turn, joint.position ?? [0, 0, 0]));
    if (slides) at = plus(at, rotate(turn, axis), q);
    else turn = multiply(turn, about(axis, q));
    known.set(joint.name, { turn, at });
    // The last link ends where its body is.
    const end = carrying.has(joint.name) ? at : plus(at, rotate(turn, joint.center ?? [0, 0, 0]));
    return { slides, from: before.at, at, end };
  });
}

/** Make the place for the pose where positions were recorded; unpack them once the page stands. */
async function buildPose() {
  pose.channels = content.axes.map(({ name }) => find({ role: "recorded", position: name })[0]).filter(Boolean);
  if (!pose.channels.length) return;
  const host = document.getElementById("pose");
  host.hidden = false;
  pose.drawing = make("div");
  pose.words = make("figcaption", { class: "remark" });
  host.append(pose.drawing, pose.words);
  await Promise.all(pose.channels.map((channel) => channel.load()));
  if (content.joints.length) pose.frame = frameOf(pose.channels[0].on);
  drawPose();
}

/** A square that holds the arm in some hundred poses: middle and half the width, m. */
function frameOf(grid) {
  const [low, high] = [[0, 0, 0], [0, 0, 0]];
  for (let i = 0; i < grid.length; i += Math.ceil(grid.length / POSES)) {
    for (const { at, end } of placeJoints(positionsAt(i))) {
      for (const point of [at, end]) {
        point.forEach((value, k) => {
          if (Number.isFinite(value)) [low[k], high[k]] = [Math.min(low[k], value), Math.max(high[k], value)];
        });
      }
    }
  }
  const half = Math.max(...high.map((value, k) => (value - low[k]) / 2)) || 1;
  return { middle: high.map((value, k) => (value + low[k]) / 2), half };
}

const positionsAt = (i) => Object.fromEntries(pose.channels.map((one) => [one.position, one.values[i]]));

/** Draw the pose at the cursor, at the start of the view without one. */
function drawPose() {
  const grid = pose.channels[0]?.on;
  if (!pose.drawing || !grid?.x || pose.channels.some((one) => !one.values)) return;
  const i = grid.nearest(state.cursor ?? state.view[0]);
  const positions = positionsAt(i);
  const { trial, time } = placeOf(grid.x[i]);
  pose.words.textContent = `Pose in ${trial.id} at ${time.toFixed(3)} s`;
  pose.drawing.innerHTML = content.joints.length ? drawArm(placeJoints(positions)) : drawScales(positions);
}

function drawArm(links) {
  const { middle, half } = pose.frame;
  const scale = (BODY_PX / 2 - MARGIN_PX) / half;
  const view = (title, up, top) => {
    const pixel = (point) => `${(BODY_PX / 2 + (point[0] - middle[0]) * scale).toFixed(1)},${(top + BODY_PX / 2 - (point[up] - middle[up]) * scale).toFixed(1)}`;
    const lines = links.map(({ from, at, end }) => `<polyline class="link" points="${pixel(from)} ${pixel(at)} ${pixel(end)}"/>`);
    const joints = links.map(({ at, slides }) => {
      const [x, y] = pixel(at).split(",").map(Number);
      return slides ? `<rect class="joint" x="${x - 4}" y="${y - 4}" width="8" height="8"/>` : `<circle class="joint" cx="${x}" cy="${y}" r="4"/>`;
    });
    const [x, y] = pixel([0, 0, 0]).split(",").map(Number);
    return `<text x="6" y="${top + 14}">${title}</text><path class="base" d="M${x - 12} ${y + 6}h24"/>${lines.join("")}${joints.join("")}`;
  };
  return `<svg viewBox="0 0 ${BODY_PX} ${2 * BODY_PX}" role="img" aria-label="The arm at the cursor, from the side and from above">${view("from the side", 2, 0)}${view("from above", 1, BODY_PX)}</svg>`;
}

/** Each axis as a line over its range, with a mark where it is: a hand of a dial where it turns. */
function drawScales(positions) {
  const row = 62;
  const rows = pose.channels.map((one, k) => {
    const { low, step, position: name } = one;
    const value = positions[name];
    const share = (value - low) / (65534 * step || 1);
    const turns = one.unit === "rad";
    const y = k * row;
    const said = `<text x="6" y="${y + 16}"></text>`;
    if (turns) {
      const [cx, cy, r] = [BODY_PX - 40, y + 34, 24];
      return `${said}<circle class="dial" cx="${cx}" cy="${cy}" r="${r}"/><path class="link" d="M${cx} ${cy}L${cx + r * Math.cos(value)} ${cy - r * Math.sin(value)}"/>`;
    }
    return `${said}<path class="dial" d="M10 ${y + 40}h${BODY_PX - 20}"/><rect class="joint" x="${10 + (BODY_PX - 30) * share}" y="${y + 32}" width="10" height="16"/>`;
  });
  const holder = make("div");
  holder.innerHTML = `<svg viewBox="0 0 ${BODY_PX} ${row * rows.length}" role="img" aria-label="The axes at the cursor">${rows.join("")}</svg>`;
  holder.querySelectorAll("text").forEach((text, k) => (text.textContent = `${pose.channels[k].position} ${format(positions[pose.channels[k].position]?.toFixed(3) * 1)} ${pose.channels[k].unit}`));
  return holder.innerHTML;
}
