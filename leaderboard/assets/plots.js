// The page of plots: everything is counted from the judged results, one letter each.
"use strict";
(function () {
  const { state, make, axis, colour, css, dash, short } = ClosedLap;
  const { columns, rows, categories } = ClosedLap.instances;
  const tools = ClosedLap.tools;
  const at = Object.fromEntries(columns.map((name, i) => [name, i]));
  const results = tools.map((tool) => ClosedLap.results[tool.slug]);
  const names = tools.map((tool) => tool.name);
  const LEAST = 0.01; // seconds: below it a logarithmic axis says nothing
  const HEIGHT = 380;
  const hidden = new Set();
  const solved = (letter) => letter === "s" || letter === "u";
  const page = (i) => `instances/${encodeURIComponent(rows[i][at.slug] || rows[i][at.id])}.html`;
  const clamp = (time) => Math.max(LEAST, time);

  const select = document.getElementById("category");
  select.append(make("option", { value: "" }, "all"));
  for (const name of categories) select.append(make("option", { value: name }, name));
  select.addEventListener("change", () => state.set({ category: select.value }));
  const across = document.getElementById("across");
  const up = document.getElementById("up");
  for (const [box, key] of [[across, "x"], [up, "y"]]) {
    names.forEach((name, i) => box.append(make("option", { value: tools[i].slug }, name)));
    box.addEventListener("change", () => state.set({ [key]: box.value }));
  }

  let chosen = []; // the instances of the category, as places in rows
  function choose() {
    const name = state.get("category", "");
    const index = categories.indexOf(name);
    select.value = index < 0 ? "" : name;
    chosen = rows.map((_, i) => i).filter((i) => index < 0 || rows[i][at.category] === index);
    const slugs = tools.map((tool) => tool.slug);
    const first = slugs.includes(state.get("x")) ? state.get("x") : slugs[0];
    const other = slugs.includes(state.get("y")) ? state.get("y") : slugs[Math.min(1, slugs.length - 1)];
    across.value = first;
    up.value = other;
  }

  const series = (points) =>
    names.map((name, i) => ({
      label: name,
      show: !hidden.has(i),
      stroke: colour(i),
      dash: dash(i),
      width: 2,
      spanGaps: true,
      points: { show: points, size: 7, fill: colour(i) },
    }));

  const logValues = (u, values) => values.map((v) => (v === null ? null : short(v)));

  function fill(id, caption, heads, lines) {
    const place = document.getElementById(`${id}-table`);
    place.replaceChildren(ClosedLap.table(caption, heads, lines));
  }

  function cactus() {
    const sorted = results.map((one) =>
      chosen.filter((i) => solved(one.letters[i])).map((i) => one.times[i]).sort((a, b) => a - b),
    );
    const most = Math.max(0, ...sorted.map((times) => times.length));
    const steps = [0.1, 1, 10, 60, 300];
    fill("cactus", "Instances solved within a time", ["Tool", ...steps.map((t) => `${t} s`), "all"],
      names.map((name, i) => [name, ...steps.map((t) => String(sorted[i].filter((x) => x <= t).length)), String(sorted[i].length)]));
    if (!most) return null;
    const data = [Array.from({ length: most }, (_, n) => n + 1)];
    for (const times of sorted) data.push(data[0].map((n) => (n <= times.length ? clamp(times[n - 1]) : null)));
    return {
      data,
      label: `Instances solved against time, ${names.length} tools; the table below has the numbers.`,
      settings: {
        height: HEIGHT,
        scales: { x: { time: false, range: [0, most + 1] }, y: { distr: 3 } },
        axes: [axis("instances solved"), axis("time, s", { values: logValues, size: 56 })],
        series: [{}, ...series(most < 60)],
      },
    };
  }

  // Group the chosen instances by a column, in the order of its values.
  function groups(column) {
    const found = new Map();
    for (const i of chosen) {
      const value = rows[i][at[column]];
      if (value === null || value === 0) continue;
      if (!found.has(value)) found.set(value, []);
      found.get(value).push(i);
    }
    return [...found].sort(([a], [b]) => a - b);
  }

  const ran = (one, places) => places.filter((i) => one.letters[i] !== "-");
  const share = (one, places) => {
    const there = ran(one, places);
    return there.length ? (100 * there.filter((i) => solved(one.letters[i])).length) / there.length : null;
  };
  const par2 = (one, places) => {
    const there = ran(one, places);
    const time = (i) => (solved(one.letters[i]) ? one.times[i] : 2 * rows[i][at.timeout]);
    return there.length ? there.reduce((sum, i) => sum + time(i), 0) / there.length : null;
  };

  function against(id, column, scale, unit, measure, title, log) {
    const found = groups(column);
    const heads = found.map(([value, places]) => `${short(scale * value)}${unit} (${places.length})`);
    fill(id, `${title}; in brackets: instances`, ["Tool", ...heads],
      names.map((name, i) => [name, ...found.map(([, places]) => short(measure(results[i], places)))]));
    if (!found.length) return null;
    const xs = found.map(([value]) => scale * value);
    const data = [xs, ...results.map((one) => found.map(([, places]) => measure(one, places)).map((y) => (log && y !== null ? clamp(y) : y)))];
    const range = [xs[0] / 1.5, xs[xs.length - 1] * 1.5];
    return {
      data,
      label: `${title}; the table below has the numbers.`,
      settings: {
        height: HEIGHT,
        scales: { x: { time: false, distr: 3, range }, y: log ? { distr: 3 } : { range: [0, 105] } },
        axes: [
          axis(`${{ rays: "rays", neurons: "hidden neurons", width: "width of the start set, mm" }[column]}`, { splits: () => xs, values: (u, values) => values.map((v) => short(v)), filter: (u, values) => values }),
          axis(log ? "PAR-2, s" : "solved, %", { size: 56, values: log ? logValues : undefined }),
        ],
        series: [{}, ...series(true)],
      },
    };
  }

  function scatterPoints() {
    const a = results[tools.findIndex((tool) => tool.slug === across.value)];
    const b = results[tools.findIndex((tool) => tool.slug === up.value)];
    return chosen
      .filter((i) => a.letters[i] !== "-" && b.letters[i] !== "-")
      .map((i) => {
        const time = (one) => clamp(solved(one.letters[i]) ? one.times[i] : rows[i][at.timeout]);
        return { i, x: time(a), y: time(b), both: solved(a.letters[i]) && solved(b.letters[i]), a, b };
      });
  }

  function scatter() {
    const points = scatterPoints();
    const name = (box) => box.options[box.selectedIndex].text;
    const word = (one, i) => `${{ s: "sat", u: "unsat", k: "unknown", t: "timeout", e: "error", x: "incorrect" }[one.letters[i]]}, ${short(one.times[i])} s`;
    const apart = [...points].sort((p, q) => Math.abs(Math.log(q.x / q.y)) - Math.abs(Math.log(p.x / p.y)));
    fill("scatter", "Where the two differ most", ["Instance", name(across), name(up)],
      apart.slice(0, 25).map((p) => [make("a", { href: page(p.i) }, rows[p.i][at.id]), word(p.a, p.i), word(p.b, p.i)]));
    if (!points.length) return null;
    const values = points.flatMap((p) => [p.x, p.y]);
    const range = [Math.min(...values) / 1.6, Math.max(...values) * 1.6];
    const paint = (test, paintColour) => (u, seriesIndex) => {
      const ratio = devicePixelRatio || 1;
      const { ctx } = u;
      ctx.save();
      ctx.beginPath();
      ctx.rect(u.bbox.left, u.bbox.top, u.bbox.width, u.bbox.height);
      ctx.clip();
      ctx.strokeStyle = paintColour;
      ctx.lineWidth = 1.6 * ratio;
      for (const p of points.filter(test)) {
        ctx.beginPath();
        ctx.arc(u.valToPos(p.x, "x", true), u.valToPos(p.y, "y", true), 3.5 * ratio, 0, 2 * Math.PI);
        ctx.stroke();
      }
      ctx.restore();
      return null;
    };
    const sorted = [...points].sort((p, q) => p.x - q.x);
    return {
      data: [sorted.map((p) => p.x), sorted.map((p) => p.y), sorted.map((p) => p.y)],
      label: `${name(up)} against ${name(across)}: ${points.length} instances; the table below names those where they differ most.`,
      settings: {
        height: Math.min(560, Math.max(HEIGHT, document.getElementById("scatter").clientWidth * 0.7)),
        scales: { x: { time: false, distr: 3, range }, y: { distr: 3, range } },
        cursor: { drag: { x: false, y: false } },
        axes: [axis(`${name(across)}, s`, { values: logValues }), axis(`${name(up)}, s`, { values: logValues, size: 56 })],
        series: [
          {},
          { label: "both solved", paths: paint((p) => p.both, colour(0)), points: { show: false } },
          { label: "not both", paths: paint((p) => !p.both, colour(1)), points: { show: false } },
        ],
        hooks: {
          drawAxes: [
            (u) => {
              const { ctx } = u;
              ctx.save();
              ctx.strokeStyle = css("--quiet");
              ctx.setLineDash([4, 4]);
              ctx.beginPath();
              ctx.moveTo(u.valToPos(range[0], "x", true), u.valToPos(range[0], "y", true));
              ctx.lineTo(u.valToPos(range[1], "x", true), u.valToPos(range[1], "y", true));
              ctx.stroke();
              ctx.restore();
            },
          ],
          ready: [(u) => follow(u, points)],
        },
      },
    };
  }

  // Name the nearest point; a click opens its instance.
  const hint = make("p", { className: "live", role: "status" });
  function follow(u, points) {
    const nearest = (event) => {
      const box = u.over.getBoundingClientRect();
      const distance = (p) => Math.hypot(u.valToPos(p.x, "x") - (event.clientX - box.left), u.valToPos(p.y, "y") - (event.clientY - box.top));
      const best = points.reduce((one, p) => (distance(p) < distance(one) ? p : one));
      return distance(best) < 14 ? best : null;
    };
    u.over.addEventListener("mousemove", (event) => {
      const p = nearest(event);
      hint.textContent = p ? `${rows[p.i][at.id]}: ${short(p.x)} s across, ${short(p.y)} s up` : "";
      u.over.classList.toggle("on-point", Boolean(p));
    });
    u.over.addEventListener("click", (event) => {
      const p = nearest(event);
      if (p) location.href = page(p.i);
    });
  }

  choose();
  const makers = {
    cactus,
    scatter,
    rays: () => against("rays", "rays", 1, "", share, "Solved, percent, against the number of rays", false),
    neurons: () => against("neurons", "neurons", 1, "", share, "Solved, percent, against hidden neurons", false),
    width: () => against("width", "width", 1000, " mm", par2, "PAR-2 time, s, against the width of the start set", true),
  };
  const charts = Object.entries(makers).map(([id, maker]) => {
    const root = document.getElementById(id);
    if (id === "scatter") root.after(hint);
    else root.before(ClosedLap.legend(names, hidden, () => charts.forEach((chart) => chart.draw())));
    return ClosedLap.chart(root, maker);
  });
  state.listen(() => {
    choose();
    charts.forEach((chart) => chart.draw());
  });
})();
