"use strict";

// ---- selection of a group

const choice = document.getElementById("group");
function chooseGroup() {
  for (const group of document.querySelectorAll(".group")) group.hidden = group.id !== choice.value;
}
if (choice) {
  choice.addEventListener("change", chooseGroup);
  chooseGroup();
}

// ---- sorting and filtering

for (const group of document.querySelectorAll(".group")) {
  const body = group.querySelector(".frame tbody");
  const rows = [...body.rows]; // in the listed order: by rank
  const filter = group.querySelector(".filter");
  const only = group.querySelector(".only"); // the strongest attack on each defense
  const sorting = group.querySelector(".sorting");
  const headers = [...group.querySelectorAll(".frame thead th")];
  const texts = new Map(rows.map((row) => [row, row.textContent.toLowerCase()]));
  let column = "";
  let direction = 1;

  const value = (row) => row.querySelector(`[data-column="${CSS.escape(column)}"]`).dataset.value;

  function compare(one, other) {
    const [a, b] = [value(one), value(other)];
    if (a === "" || b === "") return (a === "") - (b === ""); // missing values come last in both directions
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
    group.querySelector(".count").textContent = `${count} of ${rows.length} rows`;
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

// ---- experiments: links open them, so that each has an address, and the keyboard and the browser's history work

let opener = null; // the link that the reader followed, which gets the focus back

document.addEventListener("click", (event) => {
  const link = event.target.closest('a[href^="#experiment-"]');
  if (link && !link.closest("dialog")) opener = link;
});

function openExperiment() {
  const wanted = location.hash.startsWith("#experiment-") ? document.getElementById(location.hash.slice(1)) : null;
  for (const dialog of document.querySelectorAll("dialog[open]")) if (dialog !== wanted) dialog.close();
  if (wanted && !wanted.open) {
    wanted.showModal();
    wanted.scrollTop = 0;
  }
}
window.addEventListener("hashchange", openExperiment);

for (const dialog of document.querySelectorAll("dialog")) {
  dialog.querySelector(".close").addEventListener("click", () => dialog.close());
  dialog.addEventListener("click", (event) => {
    if (event.target === dialog) dialog.close(); // outside the content
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
  const [original, reconstruction] = [stage.querySelector(".original"), stage.querySelector(".reconstruction")];
  const buttons = [...dialog.querySelectorAll(".strip button")];

  function slide() {
    stage.style.setProperty("--cut", `${slider.value}%`);
    slider.setAttribute("aria-valuetext", `${slider.value} % photograph`);
  }

  function choose(button) {
    const { sample, score, reconstruction: reconstructionPath, original: originalPath } = button.dataset;
    reconstruction.src = reconstructionPath;
    reconstruction.alt = `Reconstruction of ${sample}`;
    original.hidden = !originalPath;
    slider.disabled = !originalPath;
    if (originalPath) {
      original.src = originalPath;
      original.alt = `Photograph ${sample}`;
    }
    stage.classList.toggle("alone", !originalPath);
    dialog.querySelector("output").textContent = [sample, score, originalPath ? "" : "the results folder has no photograph of this sample"]
      .filter(Boolean)
      .join(" · ");
    for (const other of buttons) other.setAttribute("aria-pressed", String(other === button));
  }

  slider.addEventListener("input", slide);
  for (const button of buttons) button.addEventListener("click", () => choose(button));
  slide();
  // Images are fetched when the dialog first opens: first the sample of the pictures above the table.
  new MutationObserver(() => {
    if (dialog.open && !reconstruction.src) choose(buttons.find((button) => button.getAttribute("aria-pressed") === "true") ?? buttons[0]);
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
      getSelection().selectAllChildren(code); // without permission to write, the text is at least selected
      button.textContent = "Selected";
    }
    setTimeout(() => (button.textContent = "Copy"), 1500);
  });
}

openExperiment();
