// The gamepad of whoever looks, into the page's text field of that name, some 30 times a second while it is held.
//
// Runs in a hidden frame of the page and speaks through the page alone. Only a pad with the W3C's "standard" layout
// counts: axes 0 and 1 are the left stick, 2 and 3 the right one; buttons 4 and 5 the bumpers, 6 and 7 the triggers.
const page = parent;
const EVERY_MS = 33;
const write = Object.getOwnPropertyDescriptor(page.HTMLInputElement.prototype, "value").set;
let told = 0;
let held = false;

function field() {
  const label = [...page.document.querySelectorAll("label")].find((each) => each.textContent.trim() === "gamepad");
  const row = label?.parentElement.parentElement.parentElement;
  const input = row?.querySelector("input");
  return input ? { row, input } : null;
}

function numbers(pad) {
  const buttons = [5, 4, 7, 6].map((place) => pad.buttons[place]?.value ?? 0);
  return [...pad.axes.slice(0, 4), ...buttons].map((value) => value.toFixed(2));
}

function look() {
  const found = field();
  if (!found) return;
  const pads = [...page.navigator.getGamepads()].filter((pad) => pad?.connected && pad.mapping === "standard");
  found.row.parentElement.style.display = pads.length ? "" : "none";
  const values = pads.length && page.document.hasFocus() ? numbers(pads[0]) : [];
  const now = values.some((value) => Math.abs(value) > 0.1);
  if (now || held) {
    told += 1;
    write.call(found.input, [told, ...values].join(" "));
    found.input.dispatchEvent(new page.Event("input", { bubbles: true }));
  }
  held = now;
}

setInterval(look, EVERY_MS);
