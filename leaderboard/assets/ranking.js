// Tables that stand in the page: sorting, and on the ranking one category at a time and a filter.
"use strict";
(function () {
  const { state, make } = ClosedLap;
  const tables = [...document.querySelectorAll("table[data-sortable]")];

  // All score tables have the same columns and share their order.
  const stateKey = (table) => (table.classList.contains("scores") ? "sort" : table.id);

  function value(row, column) {
    const cell = row.cells[column];
    const raw = cell.dataset.value;
    if (raw === undefined) return cell.textContent.trim().toLowerCase();
    return raw === "" ? null : Number(raw);
  }

  function compare(a, b, sign) {
    if (a === null || b === null) return (a === null) - (b === null); // what is not there comes last
    if (typeof a === "string") return sign * a.localeCompare(b, "en", { numeric: true });
    return sign * (a - b);
  }

  function sort(table) {
    const text = state.get(stateKey(table), "");
    const sign = text.startsWith("-") ? -1 : 1;
    const key = text.replace(/^-/, "");
    const heads = [...table.tHead.rows[0].cells];
    const column = heads.findIndex((head) => head.dataset.key === key);
    heads.forEach((head, i) => {
      if (i === column) head.setAttribute("aria-sort", sign > 0 ? "ascending" : "descending");
      else head.removeAttribute("aria-sort");
    });
    const body = table.tBodies[0];
    const rows = [...body.rows];
    if (column < 0) rows.sort((a, b) => a.dataset.place - b.dataset.place);
    else {
      rows.sort(
        (a, b) =>
          compare(value(a, column), value(b, column), sign) || a.dataset.place - b.dataset.place,
      );
    }
    body.append(...rows);
  }

  for (const table of tables) {
    [...table.tBodies[0].rows].forEach((row, i) => {
      row.dataset.place = i;
    });
    for (const head of table.tHead.rows[0].cells) {
      const key = head.dataset.key;
      if (!key) continue;
      const button = make("button", { type: "button", className: "sort" }, head.textContent.trim());
      head.replaceChildren(button);
      button.addEventListener("click", () => {
        // Numbers are most often wanted from the top; a third click restores the page's order.
        const first = head.classList.contains("number") && key !== "rank" ? `-${key}` : key;
        const second = first.startsWith("-") ? key : `-${key}`;
        const now = state.get(stateKey(table), "");
        const next = now === first ? second : now === second ? "" : first;
        state.set({ [stateKey(table)]: next });
      });
    }
  }

  const chips = [...document.querySelectorAll("#categories a")];
  const sections = [...document.querySelectorAll(".ranking")];
  const filter = document.getElementById("filter");
  const status = document.getElementById("status");

  function show() {
    tables.forEach(sort);
    if (!chips.length) return;
    const names = chips.map((chip) => chip.dataset.category);
    const asked = state.get("category", names[0]);
    const category = names.includes(asked) ? asked : names[0];
    for (const chip of chips) {
      if (chip.dataset.category === category) chip.setAttribute("aria-current", "true");
      else chip.removeAttribute("aria-current");
    }
    const wanted = state.get("tool", "").toLowerCase();
    if (filter.value.toLowerCase() !== wanted) filter.value = state.get("tool", "");
    for (const section of sections) {
      section.hidden = section.dataset.category !== category;
      if (section.hidden) continue;
      let shown = 0;
      const rows = section.querySelector("tbody").rows;
      for (const row of rows) {
        row.hidden = !row.cells[1].textContent.toLowerCase().includes(wanted);
        shown += !row.hidden;
      }
      status.textContent = wanted ? `${shown} of ${rows.length} tools in ${category}` : "";
    }
  }

  for (const chip of chips) {
    chip.addEventListener("click", (event) => {
      event.preventDefault();
      state.set({ category: chip.dataset.category === chips[0].dataset.category ? "" : chip.dataset.category });
    });
  }
  if (filter) filter.addEventListener("input", () => state.set({ tool: filter.value }));
  state.listen(show);
  show();
})();
