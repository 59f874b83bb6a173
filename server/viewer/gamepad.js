// Sends the state of the user's gamepad about 30 times per second while it is used.
//
// Only gamepads with the W3C's "standard" layout are supported: axes 0 and 1 are the left stick, 2 and 3 the right one;
// buttons 4 and 5 are the bumpers, 6 and 7 the triggers.
const EVERY_MS = 33;
let active = false;

function numbers(pad) {
  const buttons = [5, 4, 7, 6].map((index) => pad.buttons[index]?.value ?? 0);
  return [...pad.axes.slice(0, 4), ...buttons].map((value) => value.toFixed(2));
}

function look() {
  const found = field("gamepad");
  if (!found) return;
  const pads = [...page.navigator.getGamepads()].filter((pad) => pad?.connected && pad.mapping === "standard");
  found.row.style.display = pads.length ? "" : "none";
  const values = pads.length && page.document.hasFocus() ? numbers(pads[0]) : [];
  const now = values.some((value) => Math.abs(value) > 0.1);
  if (now || active) send(found, values);
  active = now;
}

setInterval(look, EVERY_MS);
