// Light or dark theme: the browser's preference, or the choice by the page's switch, which this browser stores.
const KEY = "softfinger-theme";
const EVERY_MS = 200;
const system = page.matchMedia("(prefers-color-scheme: dark)");
let shown = false;

function dark() {
  let chosen = null;
  try {
    chosen = page.localStorage.getItem(KEY);
  } catch {} // no storage: the choice is not stored
  return chosen === null ? system.matches : chosen === "dark";
}

function look() {
  const found = field("theme");
  const button = page.document.querySelector("[data-theme-switch]");
  if (!found || !button) return;
  found.row.style.display = "none";
  const now = dark();
  button.setAttribute("aria-checked", now);
  if (now === shown) return;
  shown = now;
  send(found, [now ? "dark" : "light"]);
}

page.document.addEventListener("click", (event) => {
  if (!event.target.closest?.("[data-theme-switch]")) return;
  try {
    page.localStorage.setItem(KEY, dark() ? "light" : "dark");
  } catch {}
  look();
});
setInterval(look, EVERY_MS);
