// Tells each cell of a table its heading, which narrow screens show beside it (site.css).
for (const table of document.querySelectorAll(".md-typeset table:not([class])")) {
  const heads = [...table.querySelectorAll("th")].map((head) => head.textContent);
  for (const row of table.querySelectorAll("tbody tr")) {
    [...row.cells].forEach((cell, i) => {
      if (i > 0 && heads[i]) {
        const text = document.createElement("div");
        text.append(...cell.childNodes);
        cell.append(text);
        cell.dataset.label = heads[i];
        if (!text.textContent) cell.replaceChildren();
      }
    });
  }
}
