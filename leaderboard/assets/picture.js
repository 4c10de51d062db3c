// An instance's picture: run and step stand in the address, a slider or the keyboard moves the car.
"use strict";
(function () {
  const { state, make, axis, css, colour } = ClosedLap;
  const { scene } = ClosedLap;
  // Runs come as whole multiples of 0.1 mm and 0.1 mrad.
  for (const one of [...scene.traces, scene.witness || {}]) {
    for (const name of ["x", "y", "heading", "margin", "least", "steering"]) {
      if (name in one) one[name] = one[name].map((value) => (value === null ? null : value / 1e4));
    }
  }
  const byId = (id) => document.getElementById(id);
  const track = ClosedLap.track(byId("track"), scene);
  const runs = scene.witness ? [...scene.traces, scene.witness] : scene.traces;
  const box = byId("run");
  const slider = byId("step");
  const degrees = (radians) => (radians * 180) / Math.PI;
  const fixed = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));

  const key = (i) => (scene.witness && i === runs.length - 1 ? "witness" : String(i + 1));
  // Say of a start what sets it apart from the others.
  const NAMES = ["s", "f", "v", "heading"];
  const varies = NAMES.map((_, k) => scene.traces.some((run) => run.start[k] !== scene.traces[0].start[k]));
  if (!varies.some(Boolean)) varies[0] = true;
  const parts = (start) =>
    NAMES.map((name, k) => [name, k === 3 ? `${degrees(start[k]).toFixed(2)}°` : `${start[k].toFixed(4)} ${k === 2 ? "m/s" : "m"}`])
      .filter((_, k) => varies[k])
      .map(([name, value]) => `${name} = ${value}`)
      .join(", ");
  // Which rays are missing at some time; nothing to say of most instances.
  const faults = (run) => {
    const rays = [...new Set((run.missing || []).flat())].sort((a, b) => a - b);
    if (!rays.length) return run.mirror === undefined ? "" : `, wall ${run.mirror} mirrors and meets no ray`;
    if (run.mirror !== undefined) return `, wall ${run.mirror} mirrors: ${rays.length} rays missing at times`;
    return rays.length > 6 ? `, ${rays.length} rays missing at times` : `, missing: ${rays.join(", ")}`;
  };
  runs.forEach((run, i) => {
    const witness = key(i) === "witness";
    const start = parts(run.start) + faults(run);
    const title = witness ? `Witness of ${scene.witness.tool}: ${start}` : `${i + 1}: ${start}`;
    box.append(make("option", { value: key(i) }, `${title}${run.crashed && !witness ? " (unsafe)" : ""}`));
  });

  let chosen = -1;
  let run = null;
  let step = 0;
  let charts = [];

  const time = (i) => i * scene.period;

  function settings(label, digits) {
    return {
      height: 220,
      padding: [12, 12, 0, 0],
      scales: { x: { time: false } },
      cursor: { points: { show: false }, y: false },
      axes: [axis("time, s"), axis(label, { size: 58, values: (u, values) => values.map((v) => v.toFixed(digits)) })],
      hooks: {
        drawAxes: [
          (u) => {
            const { ctx } = u;
            const level = u.valToPos(0, "y", true);
            const inside = level >= u.bbox.top && level <= u.bbox.top + u.bbox.height;
            ctx.save();
            ctx.lineWidth = devicePixelRatio;
            if (inside) {
              ctx.strokeStyle = css("--unsafe-line");
              ctx.beginPath();
              ctx.moveTo(u.bbox.left, level);
              ctx.lineTo(u.bbox.left + u.bbox.width, level);
              ctx.stroke();
            }
            const x = u.valToPos(time(step), "x", true);
            ctx.strokeStyle = css("--ink");
            ctx.setLineDash([3, 3]);
            ctx.beginPath();
            ctx.moveTo(x, u.bbox.top);
            ctx.lineTo(x, u.bbox.top + u.bbox.height);
            ctx.stroke();
            ctx.restore();
          },
        ],
        ready: [
          (u) => {
            u.over.addEventListener("click", (event) => {
              const left = event.clientX - u.over.getBoundingClientRect().left;
              go(Math.round(u.posToVal(left, "x") / scene.period));
            });
          },
        ],
      },
    };
  }

  const longest = Math.max(...runs.map((one) => one.x.length));
  const times = Array.from({ length: longest }, (_, i) => time(i));
  const padded = (values) => times.map((_, i) => (i < values.length ? values[i] : null));

  function chart(id, values, label, digits, more) {
    // The chosen run is drawn last, above the others.
    const order = () => [...runs.keys()].sort((i, j) => (i === chosen) - (j === chosen));
    const line = (i) =>
      i === chosen ? { stroke: colour(0), width: 2 } : { stroke: css("--faint"), width: 1 };
    return ClosedLap.chart(byId(id), () => ({
      label: `${byId(id).previousElementSibling.textContent}: the chosen run and the others; the table below has the numbers.`,
      data: [times, ...order().map((i) => padded(values(runs[i]))), ...more().map(padded)],
      settings: {
        ...settings(label, digits),
        series: [
          {},
          ...order().map((i) => ({ ...line(i), points: { show: false } })),
          ...more().map(() => ({ stroke: colour(1), width: 1.5, dash: [5, 3], points: { show: false } })),
        ],
      },
    }));
  }

  function describe(readings) {
    const count = (which) => readings.filter((one) => one.state === which).length;
    const rays = [`${count("wall")} rays meet a wall`];
    if (count("far")) rays.push(`${count("far")} see none within ${scene.lidar.range} m`);
    if (count("missing")) rays.push(`${count("missing")} missing (read ${scene.lidar.range} m)`);
    const steering = step < run.steering.length ? `, steering ${fixed(degrees(run.steering[step]), 2)}°` : "";
    const end = run.crashed && step === run.x.length - 1 ? " Here the car is in the unsafe set." : "";
    return `Time ${time(step).toFixed(1)} s, margin ${fixed(run.margin[step], 4)} m${steering}. ${rays.join(", ")}.${end}`;
  }

  function place() {
    const readings = track.move(run, step, byId("rays").checked);
    byId("at").textContent = String(step);
    slider.value = step;
    slider.setAttribute("aria-valuetext", `step ${step}, ${time(step).toFixed(1)} s`);
    byId("readout").textContent = describe(readings);
    for (const one of charts) if (one.plot()) one.plot().redraw(false);
  }

  function show() {
    const wanted = runs.findIndex((_, i) => key(i) === state.get("run"));
    // Without a choice: the witness, else the run with the least margin.
    const least = runs.map((one) => Math.min(...[...one.margin, ...one.least].filter((m) => m !== null)));
    const fallback = scene.witness ? runs.length - 1 : least.indexOf(Math.min(...least));
    const index = wanted < 0 ? fallback : wanted;
    run = runs[index];
    const last = run.x.length - 1;
    const asked = Math.trunc(Number(state.get("step", "0"))) || 0;
    step = Math.min(last, Math.max(0, asked));
    slider.max = last;
    if (index !== chosen) {
      chosen = index;
      box.value = key(index);
      track.choose(index);
      charts.forEach((one) => one.draw());
      byId("run-table").replaceChildren(
        ClosedLap.table(
          "The chosen run",
          ["Step", "Time, s", "Margin, m", "Least until the next, m", "Steering, °"],
          run.x.map((_, i) => [String(i), time(i).toFixed(1), fixed(run.margin[i], 4), fixed(run.least[i], 4), i < run.steering.length ? fixed(degrees(run.steering[i]), 2) : ""]),
        ),
      );
    }
    place();
  }

  function go(to) {
    const last = run.x.length - 1;
    state.set({ step: Math.min(last, Math.max(0, to)) || "" });
  }

  let timer = null;
  const play = byId("play");
  function stop() {
    clearInterval(timer);
    timer = null;
    play.textContent = "Play";
    byId("readout").setAttribute("aria-live", "polite");
  }
  play.addEventListener("click", () => {
    if (timer !== null) {
      stop();
      return;
    }
    play.textContent = "Pause";
    byId("readout").setAttribute("aria-live", "off"); // ten times a second would be too much to hear
    if (step === run.x.length - 1) go(0);
    timer = setInterval(() => {
      if (step >= run.x.length - 1) stop();
      else go(step + 1);
    }, 1000 * scene.period);
  });
  box.addEventListener("change", () => state.set({ run: box.value }));
  slider.addEventListener("input", () => go(Number(slider.value)));
  byId("rays").addEventListener("change", place);
  byId("follow").addEventListener("change", () => {
    track.follow(byId("follow").checked);
    place();
  });
  if (scene.tube) {
    byId("tube-box").hidden = false;
    byId("tube").addEventListener("change", () => track.tube(byId("tube").checked));
  }

  const items = [["trace chosen", "chosen run"], ["trace", "sampled runs"]];
  if (scene.witness) items.push(["trace witness", "witness"]);
  if (scene.tube) items.push(["tube-mark", `reach tube: proved margin ${scene.tube.margin.toFixed(4)} m`]);
  items.push(["ray wall", "ray that meets a wall"]);
  if (runs.some((one) => one.missing)) items.push(["ray missing", "missing ray"]);
  items.push(["unsafe-mark", "unsafe set"]);
  if (scene.mirrors.length) items.push(["mirror", "wall that may mirror"]);
  if (runs.some((one) => one.mirror !== undefined)) items.push(["mirror now", "wall that mirrors in the chosen run"]);
  for (const [kind, text] of items) {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("viewBox", "0 0 24 10");
    svg.setAttribute("aria-hidden", "true");
    const mark = document.createElementNS("http://www.w3.org/2000/svg", "path");
    mark.setAttribute("class", kind);
    mark.setAttribute("d", kind.endsWith("mark") ? "M0 0 H24 V10 H0 Z" : "M0 5 H24");
    svg.append(mark);
    byId("legend").append(make("span", {}, svg, text));
  }

  show();
  charts = [
    chart("margin", (one) => one.margin, "m", 2, () => [run.least]),
    chart("steering", (one) => one.steering.map((x) => (x === null ? null : degrees(x))), "°", 0, () => []),
  ];
  state.listen(show);
})();
