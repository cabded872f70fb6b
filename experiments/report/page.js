// Start: read the data, hide the tables of other sequences, mark the variant's rows.

const DATA = JSON.parse(pick("data").textContent);

function showTables() {
  const chosen = pick("sequence").value;
  for (const figure of document.querySelectorAll(".scores[data-sequence]")) figure.hidden = figure.dataset.sequence !== chosen;
}

for (const head of document.querySelectorAll("tbody th")) {
  if (head.firstChild.textContent === DATA.variant) head.parentElement.classList.add("variant");
}
pick("sequence").addEventListener("change", showTables);
showTables();
startCurves();
startViewer();
