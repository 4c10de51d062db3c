// uPlot in this site's colours; charts follow the theme and the width of the page.
"use strict";
(function () {
  const { make } = ClosedLap;
  const COLOURS = 8;
  const DASHES = [[], [7, 4], [2, 3]];

  const css = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const colour = (i) => css(`--c${i % COLOURS}`);
  const dash = (i) => DASHES[Math.floor(i / COLOURS) % DASHES.length];

  // Draw what options(width) returns into root, anew whenever the theme or the width changes.
  // options: {data, settings (uPlot's), label (for screen readers)}, or null: nothing to draw.
  ClosedLap.chart = function (root, options) {
    let plot = null;
    let width = 0;

    function draw() {
      if (plot) plot.destroy();
      plot = null;
      width = root.clientWidth;
      const given = width ? options(width) : null;
      root.classList.toggle("empty", !given);
      if (!given) return;
      root.setAttribute("role", "img");
      root.setAttribute("aria-label", given.label);
      plot = new uPlot({ width, legend: { show: false }, ...given.settings }, given.data, root);
    }

    new ResizeObserver(() => {
      if (root.clientWidth !== width) draw();
    }).observe(root);
    document.addEventListener("themechange", draw);
    draw();
    return { draw, plot: () => plot };
  };

  ClosedLap.axis = (label, more) => ({
    stroke: css("--quiet"),
    grid: { stroke: css("--line"), width: 1 },
    ticks: { stroke: css("--line"), width: 1 },
    font: "12px system-ui, sans-serif",
    labelFont: "12px system-ui, sans-serif",
    label,
    labelSize: 22,
    size: 46,
    ...more,
  });

  ClosedLap.css = css;
  ClosedLap.colour = colour;
  ClosedLap.dash = dash;

  // A list of series as buttons that hide and show them; hidden: a set of indices.
  ClosedLap.legend = function (names, hidden, changed) {
    const list = make("ul", { className: "series" });
    names.forEach((name, i) => {
      const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      svg.setAttribute("viewBox", "0 0 24 8");
      svg.setAttribute("aria-hidden", "true");
      const line = document.createElementNS("http://www.w3.org/2000/svg", "path");
      line.setAttribute("d", "M0 4 H24");
      line.setAttribute("class", `series-${i % COLOURS}`);
      line.setAttribute("stroke-dasharray", dash(i).join(" "));
      svg.append(line);
      const button = make("button", { type: "button" }, svg, name);
      button.setAttribute("aria-pressed", String(!hidden.has(i)));
      button.addEventListener("click", () => {
        if (!hidden.delete(i)) hidden.add(i);
        button.setAttribute("aria-pressed", String(!hidden.has(i)));
        changed();
      });
      list.append(make("li", {}, button));
    });
    return list;
  };

  // A plain table: heads, and rows of text or elements.
  ClosedLap.table = function (caption, heads, rows) {
    return make(
      "table",
      {},
      make("caption", { className: "quiet" }, caption),
      make("thead", {}, make("tr", {}, ...heads.map((head, i) => make("th", { scope: "col", className: i ? "number" : "text" }, head)))),
      make(
        "tbody",
        {},
        ...rows.map((row) =>
          make("tr", {}, ...row.map((text, i) => (i ? make("td", { className: "number" }, text) : make("th", { scope: "row", className: "text" }, text)))),
        ),
      ),
    );
  };

  ClosedLap.short = (value) =>
    value === null || value === undefined ? "" : value === 0 ? "0" : value >= 100 ? value.toFixed(0) : String(+value.toPrecision(3));
})();
