// When the poses of a draw are: 64 at 10 Hz, or at times of their own.

const ROWS_A_SECOND = 10;

export const timesOf = ({ trajectory, times_s: times }) => times ?? trajectory.map((_, row) => (row + 1) / ROWS_A_SECOND);

// Where an expert, known at 10 Hz from 0.1 s on, is at a time; null behind its last pose.
function expertAt(expert, seconds) {
  const place = Math.round(1e6 * seconds * ROWS_A_SECOND) / 1e6;
  if (place > expert.length) return null;
  const rows = [[0, 0], ...expert];
  const [before, behind] = [rows[Math.floor(place)], rows[Math.ceil(place)]];
  const share = place % 1;
  return [0, 1].map((axis) => (1 - share) * before[axis] + share * behind[axis]);
}

// The mean distance of a draw from an expert at the draw's times, in m; null where they share none.
export function averageError(draw, expert) {
  const apart = timesOf(draw).flatMap((seconds, row) => {
    const there = expertAt(expert, seconds);
    return there ? [Math.hypot(draw.trajectory[row][0] - there[0], draw.trajectory[row][1] - there[1])] : [];
  });
  return apart.length ? apart.reduce((sum, each) => sum + each, 0) / apart.length : null;
}
