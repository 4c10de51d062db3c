// Runs before anything is drawn: the theme, and the one global name of this site.
"use strict";
var ClosedLap = { results: {} };

(function () {
  const key = "closedlap-theme";
  const modes = ["system", "light", "dark"];
  let mode = "system";
  try {
    mode = localStorage.getItem(key) || "system";
  } catch (error) {
    // No storage here: the system's theme it is.
  }
  if (!modes.includes(mode)) mode = "system";

  const dark = matchMedia("(prefers-color-scheme: dark)");
  function apply() {
    const system = dark.matches ? "dark" : "light";
    document.documentElement.dataset.theme = mode === "system" ? system : mode;
    document.dispatchEvent(new Event("themechange"));
  }

  apply();
  dark.addEventListener("change", apply);
  document.addEventListener("DOMContentLoaded", () => {
    const button = document.getElementById("theme");
    const label = () => {
      button.textContent = `Theme: ${mode}`;
    };
    button.hidden = false;
    label();
    button.addEventListener("click", () => {
      mode = modes[(modes.indexOf(mode) + 1) % modes.length];
      try {
        localStorage.setItem(key, mode);
      } catch (error) {
        // It then lasts for this page only.
      }
      label();
      apply();
    });
  });
})();
