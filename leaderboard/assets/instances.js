// The list of all instances.
"use strict";
(function () {
  const { make, badge, distinct, span } = ClosedLap;
  const rows = ClosedLap.instanceRows();
  const number = (key, title) => ({
    key,
    title,
    kind: "number",
    value: (row) => row[key],
    cell: (row) => String(row[key] ?? ""),
  });
  const state = (row) =>
    row.incorrect ? "disputed" : row.sat ? "sat" : row.unsat ? "unsat" : "unsolved";

  ClosedLap.grid(document.getElementById("grid"), {
    rows,
    noun: "instances",
    search: (row) => row.id,
    selects: [
      { key: "category", label: "Category", all: "all", options: ClosedLap.instances.categories, value: (row) => row.category },
      { key: "controller", label: "Controller", all: "all", options: distinct(rows, "controller"), value: (row) => row.controller },
      { key: "state", label: "Answered", all: "all", options: ["unsat", "sat", "disputed", "unsolved"], value: state },
    ],
    columns: [
      {
        key: "id",
        title: "Instance",
        kind: "text name",
        value: (row) => row.id,
        cell: (row) => make("a", { href: `instances/${encodeURIComponent(row.slug)}.html` }, row.id),
      },
      { key: "category", title: "Category", kind: "text", value: (row) => row.category, cell: (row) => row.category },
      number("rays", "Rays"),
      number("neurons", "Neurons"),
      { key: "width", title: "Start set", kind: "number", value: (row) => row.width, cell: (row) => span(row.width) },
      number("unsat", "unsat"),
      number("sat", "sat"),
      number("incorrect", "incorrect"),
      { key: "reference", title: "Reference", kind: "text", value: (row) => row.reference || null, cell: (row) => badge(row.reference) },
    ],
  });
})();
