// The two panes: what is seen, and its derivative or difference. They zoom and move together.

const lens = { zoom: 1, x: 0.5, y: 0.5 };  // magnification, and the point of the film in the middle
const element = (id) => document.getElementById(id);
const PANES = ["radiance", "signed"];
const canvasOf = (pane) => element(pane).querySelector("canvas");

function place(canvas, view) {
  const size = (canvas.width / view.width) * lens.zoom;
  return { size, left: canvas.width / 2 - lens.x * view.width * size, top: canvas.height / 2 - lens.y * view.height * size };
}

// Draw images into a pane, the first on the left of `split` (0 to 1), the second on its right.
function show(pane, view, images, split, pixel) {
  const canvas = canvasOf(pane);
  const dense = window.devicePixelRatio || 1;
  const wide = Math.max(1, Math.round(canvas.clientWidth * dense));
  canvas.width = wide;
  canvas.height = Math.round((wide * view.height) / view.width);
  const context = canvas.getContext("2d");
  const { size, left, top } = place(canvas, view);
  context.imageSmoothingEnabled = size < 1;
  const at = Math.round(split * wide);
  images.forEach((image, k) => {
    context.save();
    context.beginPath();
    if (images.length > 1) context.rect(k ? at : 0, 0, k ? wide - at : at, canvas.height);
    else context.rect(0, 0, wide, canvas.height);
    context.clip();
    context.drawImage(image, left, top, view.width * size, view.height * size);
    context.restore();
  });
  if (images.length > 1) line(context, at, canvas.height, dense);
  if (pixel) frame(context, left + pixel.x * size, top + pixel.y * size, size, dense);
}

function line(context, at, height, dense) {
  for (const [wide, ink] of [[3, "rgba(0,0,0,.45)"], [1.5, "#fff"]]) {
    context.strokeStyle = ink;
    context.lineWidth = wide * dense;
    context.beginPath();
    context.moveTo(at, 0);
    context.lineTo(at, height);
    context.stroke();
  }
  context.beginPath();
  context.arc(at, height / 2, 6 * dense, 0, 2 * Math.PI);
  context.fillStyle = "#fff";
  context.fill();
  context.strokeStyle = "rgba(0,0,0,.45)";
  context.lineWidth = dense;
  context.stroke();
}

// A pixel that is looked at, at least large enough to be found.
function frame(context, x, y, size, dense) {
  const grown = Math.max(size, 9 * dense);
  const shift = (grown - size) / 2;
  for (const [wide, ink] of [[3, "rgba(0,0,0,.75)"], [1.25, "#fff"]]) {
    context.strokeStyle = ink;
    context.lineWidth = wide * dense;
    context.strokeRect(x - shift, y - shift, grown, grown);
  }
}

// The pixel under a pointer, or null.
function pixelAt(canvas, view, event) {
  const box = canvas.getBoundingClientRect();
  const { size, left, top } = place(canvas, view);
  const x = Math.floor((((event.clientX - box.left) / box.width) * canvas.width - left) / size);
  const y = Math.floor((((event.clientY - box.top) / box.height) * canvas.height - top) / size);
  return x >= 0 && y >= 0 && x < view.width && y < view.height ? { x, y } : null;
}

function zoomAt(canvas, view, event) {
  const box = canvas.getBoundingClientRect();
  const u = (event.clientX - box.left) / box.width - 0.5;
  const v = (event.clientY - box.top) / box.height - 0.5;
  const before = lens.zoom;
  lens.zoom = Math.min(view.width / 4, Math.max(1, before * 2 ** (-event.deltaY / 300)));
  moveLens(u * (1 / before - 1 / lens.zoom), v * (1 / before - 1 / lens.zoom));
}

function moveLens(dx, dy) {
  const half = 0.5 / lens.zoom;
  lens.x = Math.min(1 - half, Math.max(half, lens.x + dx));
  lens.y = Math.min(1 - half, Math.max(half, lens.y + dy));
}

// Pointer, wheel and keys of a pane. `actions`: view(), hover(pixel), pin(pixel), step(dx, dy), split(x), redraw().
function listen(pane, actions) {
  const canvas = canvasOf(pane);
  let grip = null;
  canvas.addEventListener("pointerdown", (event) => {
    const share = (event.clientX - canvas.getBoundingClientRect().left) / canvas.clientWidth;
    grip = { x: event.clientX, y: event.clientY, moved: false, divider: pane === "radiance" && actions.nearSplit(share) };
    canvas.setPointerCapture(event.pointerId);
  });
  canvas.addEventListener("pointermove", (event) => {
    if (grip && grip.divider) {
      actions.split((event.clientX - canvas.getBoundingClientRect().left) / canvas.clientWidth);
    } else if (grip && lens.zoom > 1 && (grip.moved || Math.hypot(event.clientX - grip.x, event.clientY - grip.y) > 3)) {
      moveLens((grip.x - event.clientX) / canvas.clientWidth / lens.zoom, (grip.y - event.clientY) / canvas.clientHeight / lens.zoom);
      grip = { ...grip, x: event.clientX, y: event.clientY, moved: true };
      actions.redraw();
    } else {
      actions.hover(pixelAt(canvas, actions.view(), event));
    }
  });
  canvas.addEventListener("pointerup", (event) => {
    if (grip && !grip.moved && !grip.divider) actions.pin(pixelAt(canvas, actions.view(), event));
    grip = null;
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    zoomAt(canvas, actions.view(), event);
    actions.redraw();
  }, { passive: false });
  canvas.addEventListener("dblclick", () => { Object.assign(lens, { zoom: 1, x: 0.5, y: 0.5 }); actions.redraw(); });
  canvas.addEventListener("keydown", (event) => {
    const way = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (way) { event.preventDefault(); actions.step(...way); }
  });
}

// The colour bar: its ramp, round numbers below it, and what lies beyond.
function drawScale(kind, limit, unit, beyond) {
  const ramp = element("ramp");
  ramp.width = 512;
  ramp.height = 1;
  const low = kind === "signed" ? -limit : 0;
  const context = ramp.getContext("2d");
  const pixels = context.createImageData(512, 1);
  for (let k = 0; k < 512; k++) pixels.data.set([...colour(low + ((k + 0.5) / 512) * (limit - low), kind, limit), 255], 4 * k);
  context.putImageData(pixels, 0, 0);
  const marks = ticks(low, limit, 8);
  element("ticks").replaceChildren(...marks.found.filter((x) => Math.abs(x) <= limit * 0.97 || x === 0 && low < 0).map((x) => {
    const mark = document.createElement("span");
    mark.style.left = `${(100 * (x - low)) / (limit - low)}%`;
    mark.textContent = tickText(x, marks);
    if (x === low) mark.className = "first";
    return mark;
  }));
  element("unit").textContent = unit;
  element("beyond").textContent = beyond > 0 ? `${(100 * beyond).toPrecision(2)} % of the pixels are beyond the scale` : "";
}
