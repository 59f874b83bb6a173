// What viser 1.1 has no setting for: the sheet of controls on a phone, its note about WebGL, titles of plots, the contrast
// of labels and buttons, the state of the theme switch, names of controls for screen readers, and held keys.
const SHEET = "[style*='max-height: 60%']"; // viser shows it in narrow windows instead of the docked panel
const NOTE = "Software WebGL";
const NOTE_MS = 8000;
const doc = page.document;

function fold(tries) {
  const sheet = doc.querySelector(SHEET);
  const handle = sheet?.querySelector("[style*='cursor: pointer']");
  if (!handle || !sheet.querySelector("[role='tab']")) {
    // There is no sheet, or only prompts, which stay open.
    if (tries > 0) setTimeout(() => fold(tries - 1), 100);
    return;
  }
  handle.click();
}

function closeNote() {
  for (const note of doc.querySelectorAll(".mantine-Notification-root")) {
    if (note.textContent.startsWith(NOTE)) note.querySelector("button")?.click();
  }
}

function nameControls() {
  for (const icon of doc.querySelectorAll(".mantine-ActionIcon-root")) {
    icon.ariaLabel ??= icon.querySelector(".tabler-icon-list-search") ? "commands" : "settings";
  }
  for (const label of doc.querySelectorAll("label[for]")) {
    const row = label.parentElement.parentElement.parentElement;
    for (const each of row.querySelectorAll("[role='slider'], input")) each.ariaLabel = label.textContent;
  }
}

const style = doc.createElement("style");
style.textContent = `${SHEET}, ${SHEET} [style*="width: 20em"] { width: 100% !important; }
${SHEET} { max-height: 42% !important; } /* the fingertip is in the middle of the picture */
.u-title { line-height: 18px; padding: 0 !important; } /* three plots fit into a window of 800 pixels */
:root { --mantine-color-dimmed: color-mix(in srgb, currentColor 75%, transparent) !important; }
:root[data-mantine-color-scheme="light"] { --mantine-color-blue-outline: var(--mantine-color-blue-8) !important;
  --mantine-color-blue-filled: var(--mantine-color-blue-8) !important;
  --mantine-primary-color-filled: var(--mantine-color-blue-8) !important; }
:root[data-mantine-color-scheme="dark"] :is([role="tab"], [style*=" color: var(--mantine-primary-color-filled)"]) {
  --mantine-primary-color-filled: var(--mantine-color-blue-4); --tabs-color: var(--mantine-color-blue-4); } /* tabs, not the buttons with white text */
.mantine-Slider-markLabel { color: var(--mantine-color-dimmed) !important; }
[data-theme-switch]::before { content: ""; display: inline-block; width: 2em; height: 1.1em; margin-right: 0.5em;
  box-sizing: border-box; border: 1px solid; border-radius: 1em; vertical-align: -0.15em;
  background: radial-gradient(circle at 0.5em, currentColor 0.3em, transparent 0.36em); }
[data-theme-switch][aria-checked="true"]::before {
  background: radial-gradient(circle at calc(100% - 0.5em), transparent 0.3em, currentColor 0.36em); }`;
doc.head.append(style);
fold(20);
nameControls();
const hasControl = (node) => node.querySelector?.("label, input, .mantine-ActionIcon-root");
new MutationObserver((changes) => {
  if (changes.some((change) => [...change.addedNodes].some(hasControl))) nameControls();
}).observe(doc.body, { childList: true, subtree: true });
setTimeout(closeNote, doc.querySelector(SHEET) ? 0 : NOTE_MS);

// A held key answers one question of an experiment. Fields and the keys of the hand repeat.
doc.addEventListener("keydown", (event) => {
  if (!event.repeat || !/^([1-9]|Enter)$/.test(event.key) || event.target.closest?.("input, textarea")) return;
  event.preventDefault();
  event.stopImmediatePropagation();
}, true);
