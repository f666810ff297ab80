// Curves over iterations: one chart for each, or for each group; one cursor for all.

const CHART = { width: 480, height: 190, left: 58, right: 10, top: 8, bottom: 28 };
const INKS = { light: ["#2166ac", "#c8553d", "#3a7d44", "#8e5ea2", "#b8860b"], dark: ["#7db8ec", "#f2957e", "#84cf90", "#c9a0dc", "#e3b94f"] };
const SVG = "http://www.w3.org/2000/svg";

function drawn(name, attributes, text) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (text !== undefined) made.textContent = text;
  return made;
}

const finite = (curve) => curve.values.filter((v) => v !== null);

// From a value to a height; logarithmic where all values are positive and far apart.
function axis(curves) {
  const all = curves.flatMap(finite);
  let low = Math.min(...all), high = Math.max(...all);
  const logarithmic = low > 0 && high / low > 8;
  if (!all.length) [low, high] = [0, 1];
  if (!logarithmic && low >= 0 && low < 0.5 * high) low = 0;
  if (low === high) [low, high] = [low - Math.abs(low || 1) / 2, high + Math.abs(high || 1) / 2];
  const f = logarithmic ? Math.log10 : (v) => v;
  const room = CHART.height - CHART.top - CHART.bottom;
  const y = (v) => CHART.top + room * (1 - (f(v) - f(low)) / (f(high) - f(low)));
  let marks;
  if (logarithmic) {
    const powers = [];
    for (let k = Math.floor(Math.log10(low)); k <= Math.log10(high); k++) for (const m of [1, 2, 5]) powers.push(m * 10 ** k);
    const within = powers.filter((v) => v >= low * 0.999 && v <= high * 1.001);
    const decades = within.filter((v) => String(v.toExponential(0))[0] === "1");
    marks = (decades.length >= 3 ? decades : within).map((v) => [v, v >= 1e-3 && v < 1e5 ? String(Number(v.toPrecision(1))) : v.toExponential(0).replace("-", "−")]);
    const every = Math.ceil(marks.length / 5);
    marks = marks.filter((_, k) => k % every === 0);
  } else {
    const found = ticks(low, high, 4);
    marks = found.found.map((v) => [v, tickText(v, found)]);
  }
  return { y, marks };
}

function chart(title, curves, iterations) {
  const box = document.createElement("div");
  box.className = "chart";
  const svg = drawn("svg", { viewBox: `0 0 ${CHART.width} ${CHART.height}`, role: "img" });
  svg.append(drawn("title", {}, title));
  const { y, marks } = axis(curves);
  const first = iterations[0], last = iterations[iterations.length - 1];
  const x = (it) => CHART.left + ((it - first) / (last - first || 1)) * (CHART.width - CHART.left - CHART.right);
  for (const [v, text] of marks) {
    svg.append(drawn("line", { class: "grid", x1: CHART.left, x2: CHART.width - CHART.right, y1: y(v), y2: y(v) }));
    svg.append(drawn("text", { x: CHART.left - 8, y: y(v) + 4, "text-anchor": "end" }, text));
  }
  const floor = CHART.height - CHART.bottom;
  svg.append(drawn("line", { class: "axis", x1: CHART.left, x2: CHART.width - CHART.right, y1: floor, y2: floor }));
  const along = ticks(first, Math.max(last, first + 1), 6);
  for (const it of along.found.filter((k) => Number.isInteger(k) && k <= last)) {
    svg.append(drawn("text", { x: x(it), y: floor + 18, "text-anchor": "middle" }, String(it)));
  }
  curves.forEach((curve, k) => {
    let path = "", pen = "M";
    curve.values.forEach((v, i) => {
      if (v === null) { pen = "M"; return; }
      path += `${pen}${x(iterations[i]).toFixed(1)} ${y(v).toFixed(1)}`;
      pen = "L";
    });
    svg.append(drawn("path", { d: path, "data-ink": k }));
  });
  const cursor = drawn("line", { class: "cursor", x1: 0, x2: 0, y1: CHART.top, y2: floor, visibility: "hidden" });
  svg.append(cursor);
  const head = document.createElement("div");
  head.className = "bar";
  head.append(cell("h2", title), cell("span", ""));
  head.firstChild.title = title;
  head.lastChild.className = "muted";
  box.append(head, svg);
  if (curves.length > 1) box.append(legend(curves));
  return { box, svg, cursor, x, curves, note: head.lastChild };
}

function legend(curves) {
  const made = document.createElement("div");
  made.className = "legend";
  curves.forEach((curve, k) => {
    const entry = document.createElement("span");
    const ink = document.createElement("i");
    ink.dataset.ink = k;
    entry.append(ink, curve.name);
    made.append(entry);
  });
  return made;
}

function inkCurves() {
  const inks = INKS[theme()];
  for (const part of document.querySelectorAll("#curves path")) part.style.stroke = inks[part.dataset.ink % inks.length];
  for (const part of document.querySelectorAll("#curves i")) part.style.background = inks[part.dataset.ink % inks.length];
}

function buildCurves() {
  if (!data.iterations.length) return;
  const groups = new Map();
  for (const curve of data.curves) {
    if (!finite(curve).length) continue;
    const key = curve.group || curve.name;
    groups.set(key, [...(groups.get(key) || []), curve]);
  }
  const charts = [...groups].map(([title, curves]) => chart(title, curves, data.iterations));
  element("curves").replaceChildren(...charts.map((c) => c.box));
  const point = (k) => {
    for (const c of charts) {
      c.cursor.setAttribute("visibility", k === null ? "hidden" : "visible");
      if (k !== null) for (const end of ["x1", "x2"]) c.cursor.setAttribute(end, c.x(data.iterations[k]));
      const values = k === null ? [] : c.curves.map((curve) => (curve.values[k] === null ? "not finite" : number(curve.values[k], 3)));
      c.note.textContent = k === null ? `${c.curves[0].unit} by iteration`.trim() : `iteration ${data.iterations[k]}: ${values.join(", ")}`;
    }
  };
  for (const c of charts) {
    c.svg.addEventListener("pointermove", (event) => {
      const box = c.svg.getBoundingClientRect();
      const at = ((event.clientX - box.left) / box.width) * CHART.width;
      const off = data.iterations.map((it) => Math.abs(c.x(it) - at));
      point(off.indexOf(Math.min(...off)));
    });
    c.svg.addEventListener("pointerleave", () => point(null));
  }
  point(null);
  inkCurves();
}
