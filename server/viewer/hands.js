// Keys of two hands and pinching by the wheel: sends the total motion of each finger since this page was opened.
//
// Active only while the page has the marker for two movable fingers. Totals tolerate messages that are not sent.
const EVERY_MS = 33;
const STEP_MM = 1.0; // per key press, and per notch of the wheel
const MM_PER_S = 30.0; // while a key is held down
const HELD_MS = 200; // a key pressed for longer counts as held down
const NOTCH = 100; // pixels of scrolling, or three lines
const KEYS = {
  // key: index of the total, and sign; left hand x, y, z, right hand x, y, z
  KeyA: [0, -1], KeyD: [0, 1], KeyW: [1, 1], KeyS: [1, -1], KeyE: [2, 1], KeyQ: [2, -1],
  KeyJ: [3, -1], KeyL: [3, 1], KeyI: [4, 1], KeyK: [4, -1], KeyU: [5, 1], KeyO: [5, -1],
};
const CLOSED = 6; // index of the wheel's total
const totals = [0, 0, 0, 0, 0, 0, 0];
const pressedKeys = new Map(); // key: time of its press
const session = page.Math.random().toString(36).slice(2);
let changed = false;
let pressed = 0; // buttons of the mouse, as a bit mask
let last = page.performance.now();

const two = () => page.document.querySelector("[data-two-hands]") !== null;
const takesText = (target) => target.closest?.("input, textarea, select, [contenteditable=true]");

function move(index, distance) {
  totals[index] += distance;
  changed = true;
}

function consume(event) {
  event.preventDefault();
  event.stopImmediatePropagation();
}

page.addEventListener("keydown", (event) => {
  const key = KEYS[event.code];
  if (!key || !two() || takesText(event.target) || event.shiftKey || event.ctrlKey || event.altKey || event.metaKey) return;
  consume(event);
  if (pressedKeys.has(event.code)) return;
  pressedKeys.set(event.code, page.performance.now());
  move(key[0], STEP_MM * key[1]);
  look();
}, true);
page.addEventListener("keyup", (event) => pressedKeys.delete(event.code), true);
page.addEventListener("blur", () => pressedKeys.clear());
for (const kind of ["pointerdown", "pointermove", "pointerup", "pointercancel"]) {
  page.addEventListener(kind, (event) => { pressed = event.buttons; }, true);
}
page.addEventListener("wheel", (event) => {
  const dragged = (event.buttons | pressed) & 1 || event.altKey; // some browsers omit the buttons in wheel events
  if (!dragged || !two() || event.target.tagName !== "CANVAS") return;
  consume(event);
  move(CLOSED, (STEP_MM * event.deltaY * (event.deltaMode ? NOTCH / 3 : 1)) / NOTCH);
}, { capture: true, passive: false });

function look() {
  const found = field("hands");
  if (!found) return;
  found.row.style.display = "none";
  if (!changed) return;
  changed = false;
  send(found, [session, ...totals.map((total) => total.toFixed(2))]);
}

setInterval(() => {
  const now = page.performance.now();
  for (const [code, since] of pressedKeys) {
    const [index, sign] = KEYS[code];
    const start = page.Math.max(last, since + HELD_MS);
    if (now > start) move(index, (sign * MM_PER_S * (now - start)) / 1000);
  }
  last = now;
  look();
}, EVERY_MS);
