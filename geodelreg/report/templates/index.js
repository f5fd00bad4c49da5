"use strict";
(() => {
  const table = document.getElementById("pairs");
  const list = table.tBodies[0];
  const find = document.getElementById("find");
  const boxes = [...document.querySelectorAll("input[name=outcome]")];
  const shapes = new Map([...document.querySelectorAll("[data-pair]")].map((s) => [`pair-${s.dataset.pair}`, s]));

  function filter() {
    const wanted = find.value.trim().toLowerCase();
    const outcomes = new Set(boxes.filter((box) => box.checked).map((box) => box.value));
    let count = 0;
    for (const row of list.rows) {
      const show = outcomes.has(row.dataset.outcome) && row.textContent.toLowerCase().includes(wanted);
      row.hidden = !show;
      shapes.get(row.id)?.toggleAttribute("hidden", !show);
      count += show;
    }
    document.getElementById("found").textContent = `${count} shown`;
  }

  function sort(header) {
    const column = header.cellIndex;
    const down = header.getAttribute("aria-sort") === "ascending";
    for (const other of table.tHead.rows[0].cells) other.removeAttribute("aria-sort");
    header.setAttribute("aria-sort", down ? "descending" : "ascending");
    const sign = down ? -1 : 1;
    const key = (row) => row.cells[column].dataset.value ?? row.cells[column].textContent.trim();
    const numbers = [...list.rows].some((row) => row.cells[column].dataset.value !== undefined);
    const rows = [...list.rows].sort((one, other) => {
      const [a, b] = [key(one), key(other)];
      if (a === "" || b === "") return (a === "") - (b === "");
      return sign * (numbers ? a - b : a.localeCompare(b, "en", { numeric: true }));
    });
    list.append(...rows);
  }

  for (const header of table.tHead.rows[0].cells) {
    header.querySelector("button").addEventListener("click", () => sort(header));
  }
  find.addEventListener("input", filter);
  for (const box of boxes) box.addEventListener("change", filter);
  document.getElementById("filters").addEventListener("submit", (event) => event.preventDefault());
  for (const [id, shape] of shapes) {
    shape.addEventListener("click", () => {
      for (const row of list.rows) row.classList.toggle("chosen", row.id === id);
      document.getElementById(id).scrollIntoView({ block: "center" });
    });
  }
})();
