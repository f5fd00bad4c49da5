"use strict";
(() => {
  const body = document.body;
  const compare = document.getElementById("compare");
  const pause = document.getElementById("pause");
  const still = matchMedia("(prefers-reduced-motion: reduce)");
  const stages = [...document.querySelectorAll(".stage")];

  function choose() {
    const option = compare.selectedOptions[0];
    for (const stage of stages) {
      for (const image of stage.querySelectorAll("img")) {
        image.classList.toggle("left", image.dataset.view === option.dataset.left);
        image.classList.toggle("right", image.dataset.view === option.dataset.right);
      }
      stage.querySelector(".one").textContent = option.dataset.one;
      stage.querySelector(".two").textContent = option.dataset.two;
      say(stage);
    }
  }

  function say(stage) {
    const range = stage.querySelector("input");
    const option = compare.selectedOptions[0];
    stage.style.setProperty("--at", range.value + "%");
    range.setAttribute("aria-valuetext",
      `${range.value} % ${option.dataset.one}, ${100 - range.value} % ${option.dataset.two}`);
  }

  function mode() {
    body.dataset.mode = document.querySelector("input[name=mode]:checked").value;
    body.classList.toggle("still", still.matches);
    body.classList.remove("flipped");
    pause.textContent = still.matches ? "Flip" : "Pause";
  }

  pause.addEventListener("click", () => {
    if (still.matches) {
      body.classList.toggle("flipped");
    } else {
      pause.textContent = body.classList.toggle("still") ? "Go on" : "Pause";
    }
  });
  for (const stage of stages) stage.querySelector("input").addEventListener("input", () => say(stage));
  for (const radio of document.querySelectorAll("input[name=mode]")) radio.addEventListener("change", mode);
  for (const box of document.querySelectorAll("input[data-layer]")) {
    const show = () => document.getElementById(box.dataset.layer).toggleAttribute("hidden", !box.checked);
    box.addEventListener("change", show);
    show();
  }
  compare.addEventListener("change", choose);
  choose();
  mode();
})();
