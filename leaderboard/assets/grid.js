// Long tables made from data: filters, sorting and pages of rows.
"use strict";
(function () {
  const { state, make } = ClosedLap;
  const PAGE = 100;

  // options: columns {key, title, kind, value(row), cell(row)}, rows, selects {key, label, all,
  // options, value(row)}, search(row), noun.
  ClosedLap.grid = function (root, options) {
    const { columns, rows, selects, noun } = options;
    const search = make("input", { type: "search", autocomplete: "off", spellcheck: false });
    const controls = make("div", { className: "controls" }, make("label", {}, "Search ", search));
    const boxes = selects.map((select) => {
      const box = make("select", {}, make("option", { value: "" }, select.all));
      for (const option of select.options) {
        const [value, text] = Array.isArray(option) ? option : [option, option];
        box.append(make("option", { value }, String(text)));
      }
      controls.append(make("label", {}, `${select.label} `, box));
      box.addEventListener("change", () => state.set({ [select.key]: box.value, page: "" }));
      return box;
    });
    search.addEventListener("input", () => state.set({ q: search.value, page: "" }));

    const status = make("p", { className: "live", role: "status" });
    const heads = columns.map((column) => {
      const button = make("button", { type: "button", className: "sort" }, column.title);
      button.addEventListener("click", () => {
        const now = state.get("sort", "");
        const key = column.key;
        const next = now === key ? `-${key}` : now === `-${key}` ? "" : key;
        state.set({ sort: next, page: "" });
      });
      return make("th", { scope: "col", className: column.kind.split(" ")[0] }, button);
    });
    const body = make("tbody");
    const caption = root.dataset.caption;
    const table = make(
      "table",
      {},
      make("caption", { className: "quiet" }, caption),
      make("thead", {}, make("tr", {}, ...heads)),
      body,
    );
    const scroll = make("div", { className: "scroll", tabIndex: 0 }, table);
    scroll.setAttribute("role", "region");
    scroll.setAttribute("aria-label", caption);
    const back = make("button", { type: "button" }, "Previous");
    const on = make("button", { type: "button" }, "Next");
    const place = make("span");
    const pager = make("nav", { className: "pager" }, back, place, on);
    pager.setAttribute("aria-label", "Pages of the table");
    back.addEventListener("click", () => turn(-1));
    on.addEventListener("click", () => turn(1));
    root.replaceChildren(controls, status, scroll, pager);

    function turn(by) {
      const page = Number(state.get("page", "1")) + by;
      state.set({ page: page > 1 ? page : "" });
      scroll.scrollIntoView({ block: "nearest" });
    }

    function chosen() {
      const words = state.get("q", "").toLowerCase().split(/\s+/).filter(Boolean);
      const wanted = selects.map((select) => state.get(select.key, ""));
      let found = rows.filter(
        (row) =>
          selects.every((select, i) => !wanted[i] || String(select.value(row)) === wanted[i]) &&
          words.every((word) => options.search(row).toLowerCase().includes(word)),
      );
      const text = state.get("sort", "");
      const column = columns.find((one) => one.key === text.replace(/^-/, ""));
      if (column) {
        const sign = text.startsWith("-") ? -1 : 1;
        found = found
          .map((row, i) => [column.value(row), i, row])
          .sort(([a, i], [b, j]) => {
            if (a === null || b === null) return (a === null) - (b === null) || i - j;
            const order = typeof a === "string" ? (a < b ? -1 : a > b ? 1 : 0) : a - b;
            return sign * order || i - j;
          })
          .map(([, , row]) => row);
      }
      columns.forEach((one, i) => {
        if (one === column) {
          heads[i].setAttribute("aria-sort", text.startsWith("-") ? "descending" : "ascending");
        } else heads[i].removeAttribute("aria-sort");
      });
      return found;
    }

    function show() {
      if (search.value !== state.get("q", "")) search.value = state.get("q", "");
      boxes.forEach((box, i) => {
        box.value = state.get(selects[i].key, "");
      });
      const found = chosen();
      const pages = Math.max(1, Math.ceil(found.length / PAGE));
      const page = Math.min(pages, Math.max(1, Math.trunc(Number(state.get("page", "1"))) || 1));
      const count = (n) => n.toLocaleString("en");
      status.textContent = `${count(found.length)} of ${count(rows.length)} ${noun}`;
      body.replaceChildren(
        ...found.slice((page - 1) * PAGE, page * PAGE).map((row) =>
          make(
            "tr",
            {},
            ...columns.map((column, i) => {
              const cell = make(i ? "td" : "th", { className: column.kind }, column.cell(row));
              if (!i) cell.scope = "row";
              return cell;
            }),
          ),
        ),
      );
      place.textContent = `Page ${page} of ${pages}`;
      back.disabled = page === 1;
      on.disabled = page === pages;
      pager.hidden = pages === 1;
    }

    state.listen(show);
    show();
  };

  // What the columns of instances.js mean, as objects.
  ClosedLap.instanceRows = function () {
    const { columns, rows, categories } = ClosedLap.instances;
    return rows.map((row, place) => {
      const one = { place };
      columns.forEach((name, i) => {
        one[name] = row[i];
      });
      one.slug = one.slug || one.id;
      one.category = categories[one.category];
      return one;
    });
  };

  ClosedLap.words = {
    s: "sat", u: "unsat", k: "unknown", t: "timeout", e: "error", x: "incorrect", "-": "not run",
  };

  ClosedLap.badge = (letter) =>
    letter in ClosedLap.words && letter !== "-"
      ? make("span", { className: `verdict v-${letter}` }, ClosedLap.words[letter])
      : make("span", { className: "quiet" }, letter === "-" ? "not run" : "none");

  ClosedLap.distinct = (rows, key) =>
    [...new Set(rows.map((row) => row[key]))]
      .filter((value) => value !== null && value !== undefined)
      .sort((a, b) => (typeof a === "number" ? a - b : a < b ? -1 : 1));

  ClosedLap.span = (metres) =>
    metres === null ? "" : metres < 0.01 ? `${+(1000 * metres).toPrecision(6)} mm` : `${+(100 * metres).toPrecision(6)} cm`;
})();
