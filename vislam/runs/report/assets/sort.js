// Tables of one section as one: a click on a heading sorts all their rows by it, the largest or first word on top.

const valueOf = (row, column) => {
  const text = row.cells[column].textContent;
  const value = parseFloat(text.replaceAll("\u202f", ""));
  return isNaN(value) ? text : value;
};

function compare(a, b) {
  if (typeof a !== typeof b) return typeof a === "number" ? -1 : 1; // a dash stands behind all numbers
  return typeof a === "number" ? b - a : a.localeCompare(b);
}

export function sortTables(section) {
  const bodies = [...section.querySelectorAll("tbody")];
  const sortBy = (column) => {
    const sizes = bodies.map((body) => body.rows.length);
    const rows = bodies.flatMap((body) => [...body.rows]).map((row, place) => [valueOf(row, column), place, row]);
    rows.sort((a, b) => compare(a[0], b[0]) || a[1] - b[1]);
    const sorted = rows.map(([, , row]) => row);
    bodies.forEach((body, k) => body.append(...sorted.splice(0, sizes[k])));
  };
  for (const cell of section.querySelectorAll("th")) {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...cell.childNodes);
    button.addEventListener("click", () => sortBy(cell.cellIndex));
    cell.append(button);
  }
}
