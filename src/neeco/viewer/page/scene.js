// Reads the scene that packed.py wrote into the page. Matrices are the first three rows of 4x4 ones: 12 numbers, by rows.
const SH_C0 = 0.28209479177387814;
const STEPS = 2 ** 20 - 1; // of a body's box

async function inflated(id) {
  const packed = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// Whole numbers [N, K] of every field, from planes.
function wholeNumbers(fields, bytes, n) {
  const kinds = { uint8: [Uint8Array, 1], int8: [Int8Array, 1], uint16: [Uint16Array, 2], uint24: [Uint32Array, 3] };
  const length = fields.reduce((sum, [, width, kind]) => sum + n * width * kinds[kind][1], 0);
  if (length !== bytes.length) throw new Error(`the scene has ${bytes.length} bytes, not ${length}`);
  const found = {};
  let at = 0;
  for (const [name, width, kind] of fields) {
    const [type, size] = kinds[kind], out = new type(n * width);
    for (let b = 0; b < size; b++) {
      for (let k = 0; k < width; k++, at += n) {
        for (let i = 0; i < n; i++) out[i * width + k] |= bytes[at + i] << (8 * b);
      }
    }
    found[name] = out;
  }
  return found;
}

// The rasteriser's inputs, in their order.
function rasteriserInputs(head, raw, n) {
  const { ranges, light } = head;
  const count = (head.degree + 1) ** 2;
  const axes = ranges.turn.length / 2;
  const mean = new Float32Array(3 * n), scale = new Float32Array(3 * n), quat = new Float32Array(4 * n);
  const sh = new Float32Array(3 * n * count), falloff = new Float32Array(n), body = new Int32Array(n);
  const turn = new Float32Array(2 * axes * n);
  let i = 0;
  head.counts.forEach((rows, b) => {
    const [low, high] = ranges.mean[b];
    for (const end = i + rows; i < end; i++) {
      body[i] = b;
      falloff[i] = light.falloff[b ? 1 : 0];
      for (let k = 0; k < 3; k++) mean[3 * i + k] = low[k] + (raw.mean[3 * i + k] / STEPS) * (high[k] - low[k]);
    }
  });
  const between = (value, most, [low, high]) => low + (value / most) * (high - low);
  for (i = 0; i < n; i++) {
    const q = raw.quat.subarray(4 * i, 4 * i + 4), length = Math.hypot(...q) || 1;
    for (let k = 0; k < 4; k++) quat[4 * i + k] = q[k] / length;
    for (let k = 0; k < 3; k++) {
      scale[3 * i + k] = Math.exp(between(raw.scale[3 * i + k], 255, ranges.scale));
      sh[3 * i * count + k] = (between(raw.base[3 * i + k], 65535, ranges.base) - 0.5) / SH_C0;
    }
    for (let m = 1; m < count; m++) {
      const unit = ranges.sh[Math.floor(Math.sqrt(m)) - 1] / 127;
      for (let k = 0; k < 3; k++) sh[3 * (i * count + m) + k] = raw.sh[3 * (i * (count - 1) + m - 1) + k] * unit;
    }
    for (let k = 0; k < 2 * axes; k++) turn[2 * axes * i + k] = body[i] ? between(raw.turn[2 * axes * i + k], 65535, ranges.turn[k]) : 0;
  }
  const lamps = Float32Array.from([...light.vignette, light.shadow_width, light.background, head.threshold, ...light.lamps.flat()]);
  const shares = (values) => Float32Array.from(values, (v) => v / 255);
  return [mean, quat, scale, shares(raw.opacity), sh, falloff, shares(raw.label), turn, body, lamps];
}

async function loadScene() {
  const head = JSON.parse(new TextDecoder().decode(await inflated("head")));
  if (head.schema !== "neeco-page/1") throw new Error(`schema ${head.schema}`);
  if (!head.counts.every((count) => Number.isInteger(count) && count >= 0)) throw new Error(`counts ${head.counts}`);
  if (![0, 1, 2, 3].includes(head.degree)) throw new Error(`degree ${head.degree}`);
  const n = head.counts.reduce((a, b) => a + b, 0);
  const inputs = rasteriserInputs(head, wholeNumbers(head.fields, await inflated("scene"), n), n);
  const size = [n, head.counts[0], (head.degree + 1) ** 2, head.ranges.turn.length / 2, head.labels.length, head.light.lamps.length];
  return { head, size, inputs };
}
