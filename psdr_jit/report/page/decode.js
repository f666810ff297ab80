// The numbers of the images: the inverse of encode.py.

const data = JSON.parse(document.getElementById("data").textContent);

async function inflated() {
  const text = document.getElementById("numbers").textContent;
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Whole numbers of one image, a Float64Array for each channel; NaN where the value was not finite.
function integers(how, bytes, place, width, height) {
  const count = width * height;
  const planes = [];
  for (let c = 0; c < how.channels; c++) {
    const q = new Float64Array(count);
    for (let b = 0, unit = 1; b < how.bytes; b++, unit *= 256) {
      for (let i = 0; i < count; i++) q[i] += unit * bytes[place.at + i];
      place.at += count;
    }
    for (let i = 0; i < count; i++) {
      const code = q[i];
      q[i] = code % 2 ? -(code + 1) / 2 : code / 2;
      if (how.left[c] && i % width) q[i] += q[i - 1];
    }
    planes.push(q);
  }
  if (how.mixed) for (const c of [0, 2]) for (let i = 0; i < count; i++) planes[c][i] += planes[1][i];
  if (how.nan !== null) for (const q of planes) for (let i = 0; i < count; i++) if (q[i] === how.nan) q[i] = NaN;
  return planes;
}

function decoded(how, bytes, place, width, height, found) {
  const planes = integers(how, bytes, place, width, height);
  const value = {
    sinh: (q) => how.floor * Math.sinh(q * how.step),
    sum: (q, c, i) => q * how.step + how.of.reduce((sum, name) => sum + found.get(name).value[c][i], 0),
  }[how.scale];
  planes.forEach((plane, c) => { for (let i = 0; i < plane.length; i++) plane[i] = value(plane[i], c, i); });
  return planes;
}

// Mean of the channels. Of errors: an upper bound of the error of the mean, whatever the channels have in common.
function mean(planes) {
  const found = new Float64Array(planes[0].length);
  for (const plane of planes) for (let i = 0; i < found.length; i++) found[i] += plane[i] / planes.length;
  return found;
}

// Views with layers by name: {name, role, value: [plane per channel], stderr: the same or null, mean, meanStderr}.
async function decodeAll() {
  const bytes = await inflated();
  const place = { at: 0 };
  return data.views.map((view) => {
    const found = new Map();
    for (const layer of view.encoded) {
      const { width, height } = view;
      let value, stderr = null;
      if (layer.difference) {
        const [a, b] = layer.difference.map((name) => found.get(name).value);
        value = a.map((plane, c) => plane.map((x, i) => x - b[c][i]));
      } else {
        value = decoded(layer.value, bytes, place, width, height, found);
        if (layer.stderr) stderr = decoded(layer.stderr, bytes, place, width, height, found);
      }
      const entry = { name: layer.name, role: layer.role, value, stderr, mean: mean(value) };
      entry.meanStderr = stderr && mean(stderr);
      found.set(layer.name, entry);
    }
    return { ...view, layers: view.layers.map((name) => found.get(name)) };
  });
}
