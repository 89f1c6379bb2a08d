const figure = document.querySelector('.turning'), canvas = figure.querySelector('canvas');
const bytes = text => Uint8Array.from(atob(text), c => c.charCodeAt(0));
const shorts = text => { const b = bytes(text), view = new DataView(b.buffer), out = new Int16Array(b.length / 2);
  for (let i = 0; i < out.length; i++) out[i] = view.getInt16(2 * i, true); return out; };
const points = shorts(data.points), colors = bytes(data.colors), lines = data.lines.map(shorts);
const breaks = new Set(data.breaks);
let yaw = 0.6, pitch = 0.35, held = null, waiting = false;
figure.hidden = false;
function draw() {
  waiting = false;
  const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
  canvas.width = width * ratio; canvas.height = height * ratio;
  const pen = canvas.getContext('2d'), style = getComputedStyle(document.documentElement);
  pen.scale(ratio, ratio);
  const zoom = Math.min(width, height) * 0.62 / 16000, cy = Math.cos(yaw), sy = Math.sin(yaw);
  const cp = Math.cos(pitch), sp = Math.sin(pitch);
  const at = (a, i) => { const x = cy * a[i] - sy * a[i + 2], d = sy * a[i] + cy * a[i + 2];
    return [width / 2 + zoom * x, height / 2 + zoom * (cp * a[i + 1] - sp * d)]; };
  for (let i = 0; i < points.length; i += 3) {
    const [x, y] = at(points, i);
    pen.fillStyle = `rgb(${colors[i]},${colors[i + 1]},${colors[i + 2]})`;
    pen.fillRect(x - 1, y - 1, 2, 2);
  }
  lines.forEach((line, index) => {
    pen.strokeStyle = style.getPropertyValue(data.names[index % data.names.length]);
    pen.lineWidth = 1.8; pen.beginPath();
    for (let i = 0, on = false; i < line.length; i += 3) {
      if (line[i] === -32768) { on = false; continue; }
      const [x, y] = at(line, i);
      if (on && !breaks.has(i / 3 - 1)) pen.lineTo(x, y); else pen.moveTo(x, y);
      on = true;
    }
    pen.stroke();
  });
}
const later = () => { if (!waiting) { waiting = true; requestAnimationFrame(draw); } };
canvas.addEventListener('pointerdown', e => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
canvas.addEventListener('pointermove', e => { if (!held) return;
  yaw += (e.clientX - held[0]) * 0.01; pitch += (e.clientY - held[1]) * 0.01;
  pitch = Math.max(-1.5, Math.min(1.5, pitch)); held = [e.clientX, e.clientY]; later(); });
for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, () => { held = null; });
window.addEventListener('resize', later);
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', later);
draw();
