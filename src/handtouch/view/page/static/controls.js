// Pointer, touch and keyboard: they turn, shift and scale the hand, and open the tooltips of pads.

const KEYS = {
  ArrowLeft: (hand) => hand.rotate(-30, 0), ArrowRight: (hand) => hand.rotate(30, 0),
  ArrowUp: (hand) => hand.rotate(0, 30), ArrowDown: (hand) => hand.rotate(0, -30),
  "+": (hand) => hand.zoom(0.85), "=": (hand) => hand.zoom(0.85), "-": (hand) => hand.zoom(1 / 0.85), 0: (hand) => hand.resetView(),
};

// Connects the canvas of the hand; `changed` is called after each change.
export function controlHand(canvas, hand, tooltip, state, changed) {
  const pointers = new Map(); // positions of pressed buttons and fingers
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return { middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], apart: Math.hypot(a[0] - b[0], a[1] - b[1]) };
  };
  const point = (pad, x, y) => {
    hand.hovered = pad;
    if (pad) tooltip.show(pad, x, y, state);
    else tooltip.hide();
  };
  canvas.addEventListener("pointerdown", (event) => {
    pointers.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.setPointerCapture(event.pointerId);
    point(hand.nearest(event.clientX, event.clientY), event.clientX, event.clientY);
    changed();
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => pointers.delete(event.pointerId));
  canvas.addEventListener("pointermove", (event) => {
    const to = [event.clientX, event.clientY], from = pointers.get(event.pointerId);
    if (!from) point(hand.nearest(...to), ...to);
    else {
      const before = pointers.size > 1 ? spread() : null;
      pointers.set(event.pointerId, to);
      const moved = [to[0] - from[0], to[1] - from[1]];
      if (before) {
        const { middle, apart } = spread();
        hand.zoom(before.apart / Math.max(1, apart));
        hand.pan(middle[0] - before.middle[0], middle[1] - before.middle[1]);
      } else if (event.shiftKey || event.buttons & 6) hand.pan(...moved);
      else hand.rotate(...moved);
      point(null);
    }
    changed();
  });
  canvas.addEventListener("pointerleave", () => { point(null); changed(); });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    hand.zoom(Math.exp(event.deltaY * 0.001));
    changed();
  }, { passive: false });
  canvas.addEventListener("dblclick", () => { hand.resetView(); changed(); });
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("keydown", (event) => {
    const act = event.ctrlKey || event.metaKey || event.altKey ? undefined : KEYS[event.key];
    if (!act || !hand.scene) return;
    event.preventDefault();
    act(hand);
    changed();
  });
}

// Opens the tooltip of the unrolled pad under the pointer.
export function controlPads(canvas, pads, hand, tooltip, state, changed) {
  canvas.addEventListener("pointermove", (event) => {
    const { left, top } = canvas.getBoundingClientRect(), pad = pads.padAt(event.clientX - left, event.clientY - top);
    hand.hovered = pad;
    if (pad) tooltip.show(pad, event.clientX, event.clientY, state);
    else tooltip.hide();
    changed();
  });
  canvas.addEventListener("pointerleave", () => { hand.hovered = null; tooltip.hide(); changed(); });
}

// Opens the tooltip of the chip that is focused or under the pointer.
export function controlChips(list, hand, tooltip, state, changed) {
  const open = (event) => {
    const chip = event.target.closest("button"), pad = chip && hand.scene?.pads.find((one) => one.key === chip.dataset.key);
    if (!pad) return;
    const { left, bottom } = chip.getBoundingClientRect();
    hand.hovered = pad;
    tooltip.show(pad, left, bottom - 10, state);
    changed();
  };
  const close = () => { hand.hovered = null; tooltip.hide(); changed(); };
  for (const name of ["pointerover", "focusin", "click"]) list.addEventListener(name, open);
  for (const name of ["pointerleave", "focusout"]) list.addEventListener(name, close);
}
