// All results of one tool.
"use strict";
(function () {
  const { make, badge, distinct, words } = ClosedLap;
  const root = document.getElementById("grid");
  const { letters, times } = ClosedLap.results[root.dataset.tool];
  const rows = ClosedLap.instanceRows()
    .map((row) => ({ ...row, letter: letters[row.place], time: times[row.place] }))
    .filter((row) => row.letter !== "-");

  ClosedLap.grid(root, {
    rows,
    noun: "results",
    search: (row) => row.id,
    selects: [
      { key: "category", label: "Category", all: "all", options: distinct(rows, "category"), value: (row) => row.category },
      { key: "answer", label: "Answer", all: "all", options: distinct(rows, "letter").map((letter) => words[letter]), value: (row) => words[row.letter] },
    ],
    columns: [
      {
        key: "id",
        title: "Instance",
        kind: "text name",
        value: (row) => row.id,
        cell: (row) => make("a", { href: `../instances/${encodeURIComponent(row.slug)}.html` }, row.id),
      },
      { key: "category", title: "Category", kind: "text", value: (row) => row.category, cell: (row) => row.category },
      { key: "answer", title: "Answer", kind: "text", value: (row) => words[row.letter], cell: (row) => badge(row.letter) },
      { key: "time", title: "Time, s", kind: "number", value: (row) => row.time, cell: (row) => row.time.toFixed(2) },
      { key: "timeout", title: "Limit, s", kind: "number", value: (row) => row.timeout, cell: (row) => String(row.timeout) },
    ],
  });
})();
