"use strict";

// ---- which results

const choice = document.getElementById("board");
function chooseBoard() {
  for (const board of document.querySelectorAll(".board")) board.hidden = board.id !== choice.value;
}
if (choice) {
  choice.addEventListener("change", chooseBoard);
  chooseBoard();
}

// ---- sorting and filtering

for (const board of document.querySelectorAll(".board")) {
  const body = board.querySelector("tbody");
  const rows = [...body.rows]; // as listed: by rank
  const filter = board.querySelector(".filter");
  const only = board.querySelector(".only"); // the strongest attack on each
  const sorting = board.querySelector(".sorting");
  const headers = [...board.querySelectorAll("thead th")];
  const texts = new Map(rows.map((row) => [row, row.textContent.toLowerCase()]));
  let column = "";
  let direction = 1;

  const value = (row) => row.querySelector(`[data-column="${CSS.escape(column)}"]`).dataset.value;

  function compare(one, other) {
    const [a, b] = [value(one), value(other)];
    if (a === "" || b === "") return (a === "") - (b === ""); // what is missing stands at the end, either way
    const difference = Number(a) - Number(b);
    return direction * (Number.isNaN(difference) ? a.localeCompare(b, "en", { numeric: true }) : difference);
  }

  function show() {
    const words = filter.value.toLowerCase().split(/\s+/).filter(Boolean);
    const listed = column ? [...rows].sort(compare) : direction > 0 ? rows : [...rows].reverse();
    let count = 0;
    for (const row of listed) {
      const wanted = !only || !only.checked || row.classList.contains("strongest");
      row.hidden = !(wanted && words.every((word) => texts.get(row).includes(word)));
      count += !row.hidden;
    }
    body.append(...listed);
    for (const header of headers) {
      const name = header.dataset.column === "rank" ? "" : header.dataset.column;
      if (name === column) header.setAttribute("aria-sort", direction > 0 ? "ascending" : "descending");
      else header.removeAttribute("aria-sort");
    }
    sorting.value = column;
    board.querySelector(".count").textContent = `${count} of ${rows.length} rows`;
  }

  for (const header of headers) {
    header.querySelector("button").addEventListener("click", () => {
      const name = header.dataset.column === "rank" ? "" : header.dataset.column;
      direction = name === column ? -direction : 1;
      column = name;
      show();
    });
  }
  sorting.addEventListener("change", () => {
    column = sorting.value;
    direction = 1;
    show();
  });
  filter.addEventListener("input", show);
  if (only) only.addEventListener("change", show);
  show();
}

// ---- cells: links open them, so that each has an address, and the keyboard and the way back work as everywhere

let opener = null; // where the reader comes from: following a link takes the focus from it

document.addEventListener("click", (event) => {
  const link = event.target.closest('a[href^="#cell-"]');
  if (link && !link.closest("dialog")) opener = link;
});

function openCell() {
  const wanted = location.hash.startsWith("#cell-") ? document.getElementById(location.hash.slice(1)) : null;
  for (const dialog of document.querySelectorAll("dialog[open]")) if (dialog !== wanted) dialog.close();
  if (wanted && !wanted.open) {
    wanted.showModal();
    wanted.scrollTop = 0;
  }
}
window.addEventListener("hashchange", openCell);

for (const dialog of document.querySelectorAll("dialog")) {
  dialog.querySelector(".close").addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => {
    if (event.target === dialog) dialog.close(); // beside it
  });
  dialog.addEventListener("close", () => {
    if (location.hash === `#${dialog.id}`) history.replaceState(null, "", "#");
    if (!document.querySelector("dialog[open]")) opener?.focus();
  });
  comparison(dialog);
  copying(dialog);
}

function comparison(dialog) {
  const stage = dialog.querySelector(".stage");
  if (!stage) return;
  const slider = stage.querySelector("input");
  const [original, made] = [stage.querySelector(".original"), stage.querySelector(".made")];
  const buttons = [...dialog.querySelectorAll(".strip button")];

  function slide() {
    stage.style.setProperty("--cut", `${slider.value}%`);
    slider.setAttribute("aria-valuetext", `${slider.value} % photograph`);
  }

  function choose(button) {
    const { unit, score, made: made_, original: original_ } = button.dataset;
    made.src = made_;
    made.alt = `What the attack makes of ${unit}`;
    original.hidden = !original_;
    slider.disabled = !original_;
    if (original_) {
      original.src = original_;
      original.alt = `The photograph ${unit}`;
    }
    stage.classList.toggle("alone", !original_);
    dialog.querySelector("output").textContent = [unit, score, original_ ? "" : "the photograph is not beside these records"]
      .filter(Boolean)
      .join(" · ");
    for (const other of buttons) other.setAttribute("aria-pressed", String(other === button));
  }

  slider.addEventListener("input", slide);
  for (const button of buttons) button.addEventListener("click", () => choose(button));
  slide();
  // Pictures are fetched when they are first looked at.
  new MutationObserver(() => {
    if (dialog.open && !made.src) choose(buttons[0]);
  }).observe(dialog, { attributeFilter: ["open"] });
}

function copying(dialog) {
  const button = dialog.querySelector(".copy");
  const code = dialog.querySelector(".command code");
  button.addEventListener("click", async () => {
    try {
      await navigator.clipboard.writeText(code.textContent);
      button.textContent = "Copied";
    } catch {
      getSelection().selectAllChildren(code); // without leave to write, it is at least selected
      button.textContent = "Selected";
    }
    setTimeout(() => (button.textContent = "Copy"), 1500);
  });
}

openCell();
