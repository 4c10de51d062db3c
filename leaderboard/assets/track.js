// The picture of the track, as SVG in metres: what stands still is drawn once, the car moves.
"use strict";
(function () {
  const NS = "http://www.w3.org/2000/svg";
  const LONGEST_OVERHANG = 0.05;
  const BODY = 0.2;
  const NEAR = 3.2; // metres shown around a car that is followed

  function draw(tag, attributes, parent) {
    const element = document.createElementNS(NS, tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    if (parent) parent.append(element);
    return element;
  }

  const path = (points, closed) =>
    points.map(([x, y], i) => `${i ? "L" : "M"}${x} ${y}`).join("") + (closed ? "Z" : "");
  const line = (trace) => path(trace.x.map((x, i) => [x, trace.y[i]]), false);

  // Draw a scene into root; return functions that choose a run, move the car, show or hide parts.
  ClosedLap.track = function (root, scene) {
    const [x0, y0, x1, y1] = scene.view;
    const size = Math.max(x1 - x0, y1 - y0);
    const svg = draw("svg", { viewBox: `${x0} ${-y1} ${x1 - x0} ${y1 - y0}`, role: "img" });
    svg.setAttribute("aria-label", "The track from above, with runs, the car and its scan");
    const world = draw("g", { transform: "scale(1 -1)" }, svg);
    for (const polygon of scene.unsafe) draw("path", { class: "unsafe", d: path(polygon, true) }, world);
    for (const polygon of scene.walls) draw("path", { class: "wall", d: path(polygon, true) }, world);
    const mirrors = scene.mirrors.map((ends) => draw("path", { class: "mirror", d: path(ends, false) }, world));
    const tube = draw("g", { class: "tube" }, world);
    const sets = (scene.tube ? scene.tube.steps : []).map((polygons) => {
      const step = draw("g", {}, tube);
      for (const polygon of polygons) draw("path", { d: path(polygon, true) }, step);
      return step;
    });
    const lines = scene.traces.map((trace) => draw("path", { class: "trace", d: line(trace) }, world));
    if (scene.witness) lines.push(draw("path", { class: "trace witness", d: line(scene.witness) }, world));
    const rays = draw("g", { class: "rays" }, world);
    const car = draw("g", { class: "car" }, world);
    const { front, rear } = scene.car;
    const length = front + rear + 2 * LONGEST_OVERHANG;
    draw("rect", { x: -rear - LONGEST_OVERHANG, y: -BODY / 2, width: length, height: BODY, rx: 0.05 }, car);
    draw("path", { class: "nose", d: path([[front + LONGEST_OVERHANG, 0], [front - 0.12, BODY / 2.6], [front - 0.12, -BODY / 2.6]], true) }, car);
    const dot = draw("circle", { class: "place", r: size * 0.012 }, world);

    const bar = draw("g", { class: "scale" }, svg);
    const left = x0 + size * 0.03;
    const low = -y0 - size * 0.03;
    draw("path", { d: `M${left} ${low} h1` }, bar);
    const text = draw("text", { x: left + 1 + size * 0.015, y: low, "font-size": size * 0.028 }, bar);
    text.textContent = "1 m";
    root.replaceChildren(svg);

    function choose(index) {
      lines.forEach((one, i) => one.classList.toggle("chosen", i === index));
      const run = index < scene.traces.length ? scene.traces[index] : scene.witness;
      mirrors.forEach((one, i) => one.classList.toggle("now", i === run.mirror));
      if (run.mirror !== undefined) world.insertBefore(mirrors[run.mirror], tube);
      world.insertBefore(lines[index], rays);
    }

    function move(trace, step, showRays) {
      const x = trace.x[step];
      const y = trace.y[step];
      const heading = trace.heading[step];
      dot.setAttribute("r", (follows ? 2 * NEAR : size) * 0.012);
      car.setAttribute("transform", `translate(${x} ${y}) rotate(${(heading * 180) / Math.PI})`);
      dot.setAttribute("cx", x);
      dot.setAttribute("cy", y);
      sets.forEach((set, i) => set.classList.toggle("now", i === step));
      const missing = trace.missing && trace.missing[step];
      look(x, y);
      const readings = ClosedLap.scan(scene.walls, scene.lidar, x, y, heading, missing);
      rays.replaceChildren();
      if (showRays) {
        for (const { angle, distance, state } of readings) {
          const tip = [x + distance * Math.cos(angle), y + distance * Math.sin(angle)];
          draw("path", { class: `ray ${state}`, d: path([[x, y], tip], false) }, rays);
          if (state !== "far") draw("circle", { class: `hit ${state}`, cx: tip[0], cy: tip[1], r: (follows ? 2 * NEAR : size) * (readings.length > 200 ? 0.002 : 0.005) }, rays);
        }
      }
      return readings;
    }

    // Show the surroundings of the car, or everything; dots keep their size on the screen.
    let follows = false;
    function look(x, y) {
      const [left, low, width, height] = follows
        ? [x - NEAR, y - NEAR, 2 * NEAR, 2 * NEAR]
        : [x0, y0, x1 - x0, y1 - y0];
      svg.setAttribute("viewBox", `${left} ${-low - height} ${width} ${height}`);
      bar.classList.toggle("off", follows);
    }

    return { choose, move, follow: (on) => (follows = on), tube: (shown) => tube.classList.toggle("off", !shown) };
  };
})();
