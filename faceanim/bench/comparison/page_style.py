"""How the page of a comparison looks, and the little that it does: sorting, filters, telling of marks."""

from __future__ import annotations

STYLE = """
:root { color-scheme: light dark; --paper: #ffffff; --ink: #22262b; --soft: #5d646d; --line: #d9dce0;
  --front: #eef5e6; --failed: #fbefec; --band: #e9e7df; --link: #0b5c8a; }
@media (prefers-color-scheme: dark) { :root { --paper: #16191d; --ink: #e6e8ea; --soft: #a3abb5; --line: #363c44;
  --front: #22301f; --failed: #35231f; --band: #2a2c2b; --link: #7cc4ec; } }
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.45 system-ui, sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 1rem; }
h1 { font-size: 1.5rem; line-height: 1.2; margin: .4rem 0 1rem; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2rem 0 .4rem; }
p { margin: .3rem 0 .7rem; color: var(--soft); }
.facts { display: grid; grid-template-columns: repeat(auto-fit, minmax(15rem, 1fr)); gap: .6rem 1.5rem; margin: 0; }
.facts dt { font-size: .8rem; color: var(--soft); }
.facts dd { margin: 0; overflow-wrap: anywhere; }
figure { margin: 0; }
.chart { margin-top: 1.2rem; }
.chart img { width: 100%; height: auto; display: block; background: #fff; border: 1px solid var(--line);
  border-radius: 6px; padding: .4rem; }
figcaption { font-size: .85rem; color: var(--soft); margin-top: .3rem; overflow-wrap: anywhere; }
/* The marks have colours made for white paper, in the dark too. */
.scatter { width: 100%; height: auto; display: block; background: #fff; border: 1px solid var(--line); border-radius: 6px;
  --paper: #fff; --ink: #22262b; --soft: #5d646d; --line: #d9dce0; --band: #e9e7df; }
.wide { overflow-x: auto; }
.scatter text { font-size: 13px; fill: var(--ink); }
.scatter .soft { fill: var(--soft); }
.scatter .grid { stroke: var(--line); }
.scatter .rate { stroke: var(--soft); stroke-dasharray: 5 4; }
.scatter .band { fill: var(--band); }
.scatter path { stroke-width: 1.6; }
.scatter a:hover path, .scatter a:focus path { stroke: var(--ink); stroke-width: 3.5; }
.scatter a:focus { outline: none; }
.told { min-height: 2.9em; }
.filters { display: flex; flex-wrap: wrap; gap: .6rem; align-items: flex-start; margin-top: 1.5rem; }
.filters fieldset { border: 1px solid var(--line); border-radius: 6px; padding: .2rem .7rem .4rem; margin: 0; }
.filters legend { font-size: .8rem; color: var(--soft); }
.filters label { margin-right: .8rem; white-space: nowrap; display: inline-block; }
.filters .shown { width: 100%; margin: 0; font-size: .85rem; }
.scroll { overflow-x: auto; border: 1px solid var(--line); border-radius: 6px; }
.scroll:focus-visible, button:focus-visible { outline: 2px solid var(--link); outline-offset: -2px; }
table { border-collapse: separate; border-spacing: 0; font-size: .85rem; }
th, td { padding: .3rem .6rem; text-align: left; border-bottom: 1px solid var(--line); white-space: nowrap; }
td.number { text-align: right; font-variant-numeric: tabular-nums; }
thead th { vertical-align: bottom; padding: 0; white-space: normal; }
thead button { font: inherit; font-weight: 600; color: inherit; background: none; border: 0; width: 100%;
  padding: .4rem .6rem; text-align: left; cursor: pointer; }
thead th[aria-sort="ascending"] button::after { content: " \\25b2"; }
thead th[aria-sort="descending"] button::after { content: " \\25bc"; }
th:first-child { position: sticky; left: 0; z-index: 1; background: var(--paper); }
tbody th { font-weight: 500; white-space: normal; min-width: 15rem; max-width: 20rem; overflow-wrap: anywhere; }
tr.front > *, tr.front > th:first-child { background: var(--front); }
tr.front th { font-weight: 700; }
tr.failed > *, tr.failed > th:first-child { background: var(--failed); }
td.reason { white-space: normal; }
td.reason div { position: sticky; left: 0; max-width: 60rem; overflow-wrap: anywhere; }
tr:target > *, tr:focus > * { box-shadow: inset 0 2px var(--link), inset 0 -2px var(--link); }
tr:focus { outline: none; }
.swatch { display: inline-block; width: .7em; height: .7em; border-radius: 2px; margin-right: .45em; }
.gallery { display: grid; grid-template-columns: repeat(auto-fill, minmax(230px, 1fr)); gap: 1rem; }
.gallery img { width: 100%; height: auto; display: block; border-radius: 6px; border: 1px solid var(--line); }
.gallery a { display: block; }
[hidden] { display: none !important; }
@media (max-width: 600px) {
  main { padding: .7rem; }
  h1 { font-size: 1.25rem; }
  tbody th { min-width: 7.5rem; max-width: 8.5rem; }
  .gallery { grid-template-columns: repeat(auto-fill, minmax(150px, 1fr)); gap: .6rem; }
  .wide img { width: 900px; max-width: none; }
  .wide svg { width: 640px; }
  td.reason div { max-width: min(60rem, calc(100vw - 12.5rem)); }
}
@media print {
  :root { color-scheme: light; --paper: #fff; --ink: #000; --soft: #333; --line: #bbb; --front: #eee; --failed: #f6f6f6;
    --band: #e4e4e4; }
  @page { size: A4 landscape; margin: 10mm; }
  main { max-width: none; padding: 0; }
  .filters, .told, .scatter, .screen { display: none; }
  .scroll { overflow: visible; border: 0; }
  table { font-size: 5.6pt; }
  th, td { padding: 1pt 2pt; white-space: normal; }
  thead button { padding: 1pt 2pt; }
  tbody th { min-width: 0; }
  th:first-child { position: static; }
  tr, figure { break-inside: avoid; }
  .gallery { grid-template-columns: repeat(4, 1fr); }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; }
}
"""

SCRIPT = """
"use strict";
const all = (what, from) => Array.from((from || document).querySelectorAll(what));
const body = document.querySelector("tbody"), heads = all("thead th");
const key = (row, k) => {
  let n = 0, at = k;
  while (n < row.cells.length && at >= row.cells[n].colSpan) at -= row.cells[n++].colSpan;
  const cell = row.cells[n];
  if (!cell || cell.colSpan > 1) return null;
  if (cell.dataset.value !== undefined) return Number(cell.dataset.value);
  return cell.dataset.sort || null;
};
const compare = (a, b) => typeof a === "number" && typeof b === "number" ? a - b :
  String(a).localeCompare(String(b), "en", {numeric: true});
heads.forEach((head, k) => head.querySelector("button").addEventListener("click", () => {
  const down = head.getAttribute("aria-sort") === "ascending";
  heads.forEach(other => other.setAttribute("aria-sort", other === head ? (down ? "descending" : "ascending") : "none"));
  const failed = row => row.classList.contains("failed");
  all("tr", body).map((row, n) => [row, key(row, k), n]).sort(([r, a, m], [s, b, n]) => {
    if (failed(r) !== failed(s)) return failed(r) - failed(s);
    if ((a === null) !== (b === null)) return (a === null) - (b === null);
    return (a === null ? 0 : (down ? -1 : 1) * compare(a, b)) || m - n;
  }).forEach(([row]) => body.append(row));
}));
const things = all("[data-backend]"), boxes = all("[data-filter]"), only = document.querySelector("[data-front]");
const filter = () => {
  const off = new Set(boxes.filter(box => !box.checked).map(box => box.dataset.filter + " " + box.value));
  const hidden = t => off.has("backend " + t.dataset.backend) || off.has("density " + t.dataset.density) ||
    (only.checked && t.dataset.best !== "1");
  things.forEach(t => t.toggleAttribute("hidden", hidden(t)));
  const rows = all("tr", body);
  document.querySelector(".shown").textContent =
    rows.filter(row => !row.hasAttribute("hidden")).length + " of " + rows.length + " rows shown";
};
document.querySelector(".filters").addEventListener("change", filter);
document.querySelector(".filters").addEventListener("submit", event => event.preventDefault());
filter();
const told = document.querySelector(".told");
all(".scatter a").forEach(link => ["mouseenter", "focus"].forEach(kind =>
  link.addEventListener(kind, () => { told.textContent = link.dataset.told; })));
"""
