"use strict";

// What is empty stays last in both directions.
function compare(a, b, direction) {
  if (a === "" || b === "") return (a === "") - (b === "");
  const [x, y] = [Number(a), Number(b)];
  const order = Number.isNaN(x) || Number.isNaN(y) ? a.localeCompare(b) : x - y;
  return direction === "ascending" ? order : -order;
}

// What a cell sorts by: its data-value, or else its text, or in a column of numbers the one that this begins with.
function valueOf(row, header) {
  const cell = row.cells[header.cellIndex];
  const text = cell.dataset.value ?? cell.textContent.trim();
  return text && header.classList.contains("number") ? String(parseFloat(text.replaceAll(",", ""))) : text;
}

for (const table of document.querySelectorAll("table")) {
  table.tHead.addEventListener("click", (event) => {
    const header = event.target.closest("button")?.parentElement;
    if (!header) return;
    // Numbers are first asked for from the best down, ranks and words from the first up.
    const first = header.classList.contains("number") && header.cellIndex > 0 ? "descending" : "ascending";
    const other = first === "ascending" ? "descending" : "ascending";
    const direction = header.getAttribute("aria-sort") === first ? other : first;
    for (const cell of table.tHead.rows[0].cells) cell.removeAttribute("aria-sort");
    header.setAttribute("aria-sort", direction);
    for (const body of table.tBodies) {
      const rows = [...body.querySelectorAll("tr[data-origin]")]; // what stands above a group of rows stays there
      rows.sort((a, b) => compare(valueOf(a, header), valueOf(b, header), direction));
      body.append(...rows);
    }
  });
}

const filters = document.querySelector(".filters");
filters.addEventListener("submit", (event) => event.preventDefault());
filters.addEventListener("change", (event) => {
  if (event.target.type === "checkbox") document.body.classList.toggle("all", event.target.checked);
  const wanted = [...new FormData(filters)].filter(([, value]) => value !== "");
  const refused = (element) => wanted.some(([name, value]) => element.dataset[name] !== value);
  const rows = [...document.querySelectorAll("tr[data-origin]")];
  for (const row of rows) row.hidden = refused(row);
  for (const figure of document.querySelectorAll("figure")) {
    figure.hidden = "origin" in figure.dataset ? refused(figure) : wanted.length > 0; // of several budgets and sources
  }
  const empty = (part, what) => ![...part.querySelectorAll(what)].some((element) => !element.hidden);
  for (const body of document.querySelectorAll("tbody")) body.hidden = empty(body, "tr[data-origin]");
  for (const part of document.querySelectorAll("details.more, .models")) part.hidden = empty(part, "figure");
  for (const section of document.querySelectorAll("section")) section.hidden = empty(section, "tr[data-origin]");
  for (const link of document.querySelectorAll("nav a")) link.hidden = document.querySelector(link.hash).hidden;
  const shown = rows.filter((row) => !row.hidden).length;
  filters.querySelector("output").textContent = wanted.length ? `${shown} of ${rows.length} rows` : "";
});
