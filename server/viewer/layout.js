// What viser 1.1 has no setting for: the sheet of controls on a phone, its note about WebGL, titles of plots, and held keys.
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

const style = doc.createElement("style");
style.textContent = `${SHEET}, ${SHEET} [style*="width: 20em"] { width: 100% !important; }
.u-title { line-height: 18px; padding: 0 !important; }`; // three plots fit into a window of 800 pixels
doc.head.append(style);
fold(20);
setTimeout(closeNote, doc.querySelector(SHEET) ? 0 : NOTE_MS);

// A held key answers one question of an experiment. Fields and the keys of the hand repeat.
doc.addEventListener("keydown", (event) => {
  if (!event.repeat || !/^([1-9]|Enter)$/.test(event.key) || event.target.closest?.("input, textarea")) return;
  event.preventDefault();
  event.stopImmediatePropagation();
}, true);
