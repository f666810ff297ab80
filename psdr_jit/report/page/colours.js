// From numbers to colours.

const hex = (text) => [1, 3, 5].map((k) => parseInt(text.slice(k, k + 2), 16));
const stops = (words) => words.split(" ").map(hex);

// Blue is negative, red positive; 0 is the colour of the page. Errors go from that colour to violet.
const SCALES = {
  light: {
    signed: stops("#053061 #2166ac #4393c3 #92c5de #d1e5f0 #f7f7f7 #fddbc7 #f4a582 #d6604d #b2182b #67001f"),
    size: stops("#f7f7f7 #e0dcec #bfb4d8 #9e86c3 #7f56ad #612d91 #41106b #25043f"),
  },
  dark: {
    signed: stops("#c9e6ff #84c1f3 #4794d8 #2b659e #223f5c #1d2229 #5b2f2c #9b4136 #d8634c #f5a687 #fde3d3"),
    size: stops("#1d2229 #35294f #523a7c #7350a5 #986cc4 #bd90d9 #dcb8ea #f6e4fa"),
  },
};
const UNKNOWN = [255, 190, 0];  // not finite

const theme = () => document.documentElement.dataset.theme;

function mix(table, t) {
  const x = Math.min(1, Math.max(0, t)) * (table.length - 1);
  const k = Math.min(table.length - 2, Math.floor(x));
  return table[k].map((a, c) => a + (table[k + 1][c] - a) * (x - k));
}

// Colour of x on a scale that ends at `limit`.
function colour(x, kind, limit) {
  if (Number.isNaN(x)) return UNKNOWN;
  const table = SCALES[theme()][kind];
  return mix(table, kind === "signed" ? 0.5 + x / limit / 2 : x / limit);
}

function srgb(x) {
  const v = Math.min(1, Math.max(0, x));
  return 255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055);
}

// An image of the size of the film, as a canvas.
function painted(width, height, rgb) {
  const canvas = document.createElement("canvas");
  canvas.width = width;
  canvas.height = height;
  const context = canvas.getContext("2d");
  const pixels = context.createImageData(width, height);
  for (let i = 0; i < width * height; i++) {
    const [r, g, b] = rgb(i);
    pixels.data.set([r, g, b, 255], 4 * i);
  }
  context.putImageData(pixels, 0, 0);
  return canvas;
}

function radianceCanvas(view, layer, stopsUp) {
  const gain = 2 ** stopsUp;
  const [r, g, b] = layer.value.length >= 3 ? layer.value : [layer.value[0], layer.value[0], layer.value[0]];
  return painted(view.width, view.height, (i) =>
    Number.isNaN(r[i] + g[i] + b[i]) ? UNKNOWN : [srgb(gain * r[i]), srgb(gain * g[i]), srgb(gain * b[i])]);
}

const signedCanvas = (view, plane, kind, limit) =>
  painted(view.width, view.height, (i) => colour(plane[i], kind, limit));

// The size that all but one in a hundred non-zero values stay below.
function robustLimit(planes) {
  const sizes = [];
  for (const plane of planes) for (const x of plane) if (x !== 0 && Number.isFinite(x)) sizes.push(Math.abs(x));
  if (!sizes.length) return 1;
  const sorted = Float64Array.from(sizes).sort();
  return sorted[Math.min(sorted.length - 1, Math.floor(0.99 * sorted.length))];
}

// As many digits as are stored.
const DIGITS = Math.max(2, Math.min(5, Math.floor(-Math.log10(data.precision)) + 1));

function number(x, digits = DIGITS) {
  if (Number.isNaN(x)) return "not finite";
  if (x === 0) return "0";
  const size = Math.abs(x);
  const text = size >= 1e-4 && size < 1e5 ? x.toPrecision(digits) : x.toExponential(digits - 1);
  const plain = size >= 1e-4 && size < 1e5 && text.includes("e") ? String(Number(text)) : text.replace("e+", "e");
  return plain.replaceAll("-", "−");
}

// Round numbers between two others, about so many.
function ticks(from, to, about) {
  const raw = (to - from) / about;
  const unit = 10 ** Math.floor(Math.log10(raw));
  const step = unit * [1, 2, 5, 10].find((m) => m * unit >= raw);
  const found = [];
  for (let k = Math.ceil(from / step - 1e-9); k * step <= to * (1 + 1e-9); k++) found.push(k * step);
  return { found, digits: Math.max(0, -Math.floor(Math.log10(step))), step };
}

function tickText(x, { digits, step }) {
  if (step < 1e-4 || Math.abs(x) >= 1e5) return x === 0 ? "0" : x.toExponential(0).replace("-", "−");
  return x.toFixed(digits).replace("-", "−");
}
