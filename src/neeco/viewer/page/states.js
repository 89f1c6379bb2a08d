// Values of the sliders -> poses of the instruments. Lengths in mm, angles in rad, cameras in OpenCV axes.

function multiply(a, b) {
  const c = new Array(12).fill(0);
  for (let i = 0; i < 3; i++) {
    for (let j = 0; j < 4; j++) {
      for (let k = 0; k < 3; k++) c[4 * i + j] += a[4 * i + k] * b[4 * k + j];
      if (j === 3) c[4 * i + 3] += a[4 * i + 3];
    }
  }
  return c;
}

function unit(v) {
  const length = Math.hypot(...v) || 1;
  return v.map((x) => x / length);
}

// A turn by `angle` about the line through `point` along unit `axis`.
function about(point, axis, angle) {
  const [x, y, z] = axis, c = Math.cos(angle), s = Math.sin(angle), t = 1 - c;
  const r = [t * x * x + c, t * x * y - s * z, t * x * z + s * y, t * x * y + s * z, t * y * y + c, t * y * z - s * x,
    t * x * z - s * y, t * y * z + s * x, t * z * z + c];
  const moved = [0, 1, 2].map((i) => point[i] - (r[3 * i] * point[0] + r[3 * i + 1] * point[1] + r[3 * i + 2] * point[2]));
  return [r[0], r[1], r[2], moved[0], r[3], r[4], r[5], moved[1], r[6], r[7], r[8], moved[2]];
}

function shifted(by) {
  return [1, 0, 0, by[0], 0, 1, 0, by[1], 0, 0, 1, by[2]];
}

function quaternion(m) {
  const trace = m[0] + m[5] + m[10];
  const q = trace > 0 ? [trace + 1, m[9] - m[6], m[2] - m[8], m[4] - m[1]]
    : m[0] > m[5] && m[0] > m[10] ? [m[9] - m[6], 1 + m[0] - m[5] - m[10], m[1] + m[4], m[2] + m[8]]
    : m[5] > m[10] ? [m[2] - m[8], m[1] + m[4], 1 + m[5] - m[0] - m[10], m[6] + m[9]]
    : [m[4] - m[1], m[2] + m[8], m[6] + m[9], 1 + m[10] - m[0] - m[5]];
  return unit(q);
}

function rotation([w, x, y, z]) {
  return [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y), 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
    2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)];
}

// Between two rigid matrices: positions on a line, rotations by slerp.
function between(a, b, share) {
  if (share === 0) return a.slice();
  let p = quaternion(a), q = quaternion(b), dot = p.reduce((sum, v, i) => sum + v * q[i], 0);
  if (dot < 0) { q = q.map((v) => -v); dot = -dot; }
  const angle = Math.acos(Math.min(1, dot));
  const [one, two] = angle < 1e-6 ? [1 - share, share] : [Math.sin((1 - share) * angle) / Math.sin(angle), Math.sin(share * angle) / Math.sin(angle)];
  const r = rotation(unit(p.map((v, i) => one * v + two * q[i])));
  const at = (i) => a[4 * i + 3] + share * (b[4 * i + 3] - a[4 * i + 3]);
  return [r[0], r[1], r[2], at(0), r[3], r[4], r[5], at(1), r[6], r[7], r[8], at(2)];
}

// A frame number with a fraction -> [the frame before, the one after, share of the way].
function neighbours(head, frame) {
  const last = head.recorded.names.length - 1, first = Math.max(0, Math.min(Math.floor(frame), last));
  return [first, Math.min(first + 1, last), frame - first];
}

// Roll about the shaft, then pitch and yaw about its end, then the slide along it: steering.py's, in the instrument's frame.
function offset({ end, along, side, up }, { slide, roll, yaw, pitch }) {
  return [about(end, up, yaw), about(end, side, pitch), about(end, along, roll)].reduce(multiply, shifted(along.map((v) => v * slide)));
}

// Of every instrument: its pose (world_from_instrument) and its joints' readings, as `wish` has them.
function standings(head, wish) {
  const { poses, joints } = head.recorded, [k, l, share] = neighbours(head, wish.frame);
  return head.instruments.map((instrument, index) => {
    const own = wish.instruments[index];
    const recorded = between(poses[k][index], poses[l][index], share);
    const readings = joints[k][index].map((v, j) => own.joints[j] ?? v + share * (joints[l][index][j] - v));
    return { pose: multiply(recorded, offset(instrument.shaft, own)), readings };
  });
}

// The rasteriser's state: 8 poses of 16 numbers, then 8 times 8 axes of 8.
function packedState(head, wish) {
  const state = new Float32Array(8 * 16 + 8 * 8 * 8);
  standings(head, wish).forEach(({ pose, readings }, index) => {
    state.set([...pose, ...quaternion(pose)], 16 * index);
    head.instruments[index].axes.forEach(({ pivot, axis, joint, slides }, k) => state.set([...pivot, ...axis, readings[joint], +slides], 128 + 64 * index + 8 * k));
  });
  return state;
}
