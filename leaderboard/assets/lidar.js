// The LiDAR, as the model defines it: rays equally spaced over the field of view, the first at its
// right end; each reads the distance to the first wall, at most the range; a missing one the range.
"use strict";
(function () {
  // The distance along a ray from (x, y) in direction (dx, dy) to an edge from p to q, or Infinity.
  function toEdge(x, y, dx, dy, p, q) {
    const ex = q[0] - p[0];
    const ey = q[1] - p[1];
    const cross = dx * ey - dy * ex;
    if (cross === 0) return Infinity;
    const px = p[0] - x;
    const py = p[1] - y;
    const distance = (px * ey - py * ex) / cross;
    const along = (px * dy - py * dx) / cross;
    return distance >= 0 && along >= 0 && along <= 1 ? distance : Infinity;
  }

  // Readings of all rays: {angle, distance, state}, state one of wall, far, missing. walls: convex
  // polygons, corners in order; missing: indices of rays.
  ClosedLap.scan = function (walls, lidar, x, y, heading, missing) {
    const gone = new Set(missing || []);
    const readings = [];
    for (let i = 0; i < lidar.rays; i++) {
      const angle = heading - lidar.view / 2 + (lidar.view * i) / (lidar.rays - 1);
      const dx = Math.cos(angle);
      const dy = Math.sin(angle);
      let distance = lidar.range;
      let state = gone.has(i) ? "missing" : "far";
      if (state === "far") {
        for (const wall of walls) {
          for (let k = 0; k < wall.length; k++) {
            const here = toEdge(x, y, dx, dy, wall[k], wall[(k + 1) % wall.length]);
            if (here < distance) {
              distance = here;
              state = "wall";
            }
          }
        }
      }
      readings.push({ angle, distance, state });
    }
    return readings;
  };
})();
