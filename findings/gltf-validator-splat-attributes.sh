#!/usr/bin/env bash
# gltf-validator 2.0.0-dev.3.10 (npm): a valid GLB whose points carry Gaussians by the ratified extension
# KHR_gaussian_splatting is reported as invalid: one error for every attribute of the extension.
#
# Expected: as the validator knows no such extension, it says so once (UNSUPPORTED_EXTENSION, information) and leaves
# what belongs to it alone, as it does with extensions inside of objects. Seen: the attributes' names hold a colon, as
# the extension prescribes ("KHR_gaussian_splatting:ROTATION"), and each of the four (rotation, scale, opacity, first
# harmonic) is an error MESH_PRIMITIVE_INVALID_ATTRIBUTE. A pipeline that refuses files with errors refuses every splat.
# Exit status 0: as described. 1: it has changed.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
npm install --silent --no-fund --no-audit gltf-validator@2.0.0-dev.3.10
cat > run.js <<'JS'
const { validateBytes, version } = require("gltf-validator");
// one Gaussian: position, rotation (xyzw), scale, opacity, first harmonic
const columns = [["POSITION", [0, 0, 0]], ["ROTATION", [0, 0, 0, 1]], ["SCALE", [1, 1, 1]], ["OPACITY", [0.5]],
                 ["SH_DEGREE_0_COEF_0", [0, 0, 0]]];
const types = { 1: "SCALAR", 3: "VEC3", 4: "VEC4" };
const attributes = {}, accessors = [], bufferViews = [], numbers = [];
columns.forEach(([name, values], index) => {
  attributes[index ? `KHR_gaussian_splatting:${name}` : name] = index;
  bufferViews.push({ buffer: 0, byteOffset: 4 * numbers.length, byteLength: 4 * values.length, target: 34962 });
  accessors.push({ bufferView: index, componentType: 5126, count: 1, type: types[values.length],
                   ...(index ? {} : { min: values, max: values }) });
  numbers.push(...values);
});
const extension = { KHR_gaussian_splatting: { kernel: "ellipse", colorSpace: "srgb_rec709_display" } };
const content = {
  asset: { version: "2.0" }, extensionsUsed: ["KHR_gaussian_splatting"], scene: 0, scenes: [{ nodes: [0] }],
  nodes: [{ mesh: 0 }], meshes: [{ primitives: [{ attributes, mode: 0, extensions: extension }] }],
  accessors, bufferViews, buffers: [{ byteLength: 4 * numbers.length }],
};
let json = Buffer.from(JSON.stringify(content));
json = Buffer.concat([json, Buffer.alloc((4 - (json.length % 4)) % 4, " ")]);
const binary = Buffer.from(new Float32Array(numbers).buffer);
const words = (...values) => Buffer.from(new Uint32Array(values).buffer);
const parts = [words(json.length, 0x4e4f534a), json, words(binary.length, 0x004e4942), binary];
const size = 12 + parts.reduce((sum, part) => sum + part.length, 0);
const file = new Uint8Array(Buffer.concat([words(0x46546c67, 2, size), ...parts]));
validateBytes(file).then(report => {
  const counts = {};
  for (const issue of report.issues.messages) counts[issue.code] = (counts[issue.code] || 0) + 1;
  console.log(version(), JSON.stringify(counts));
  const expected = { UNSUPPORTED_EXTENSION: 1, MESH_PRIMITIVE_INVALID_ATTRIBUTE: 4 };
  const same = Object.keys(counts).length === 2 && Object.keys(expected).every(code => counts[code] === expected[code]);
  process.exit(same ? 0 : 1);
});
JS
node run.js && echo "as described"
# Output of 2026-11-29:
#   2.0.0-dev.3.10 {"UNSUPPORTED_EXTENSION":1,"MESH_PRIMITIVE_INVALID_ATTRIBUTE":4}
#   as described
