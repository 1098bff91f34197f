"use strict";
// Rows of the table of runs by any of its columns; a second click turns the order round.

const table = document.querySelector("#runs table");
const body = table.tBodies[0];

function valueOf(row, column) {
  const text = row.cells[column].dataset.v ?? row.cells[column].textContent;
  return text === "" ? null : isNaN(text) ? text : Number(text);
}

function compare(a, b) {
  if (a === null || b === null) return (a === null) - (b === null);
  return typeof a === typeof b && typeof a === "number" ? a - b : String(a).localeCompare(String(b), "en", { numeric: true });
}

for (const head of table.tHead.rows[0].cells) {
  const button = head.querySelector("button");
  if (!button) continue;
  button.addEventListener("click", () => {
    const down = head.getAttribute("aria-sort") === "ascending";
    for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    const rows = [...body.rows].map((row) => [valueOf(row, head.cellIndex), row]);
    rows.sort(([a], [b]) => (a === null || b === null ? compare(a, b) : down ? compare(b, a) : compare(a, b)));
    body.append(...rows.map(([, row]) => row));
  });
}

document.documentElement.dataset.ready = "yes";
