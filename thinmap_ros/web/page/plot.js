// A small plot of one curve that grows; when it is full, every second point is left out.

const MOST = 600;

export class Plot {
  constructor(canvas, title, unit) {
    this.canvas = canvas;
    this.title = title;
    this.unit = unit;
    this.points = [];
  }

  add(x, y) {
    const last = this.points.at(-1);
    if (last && x < last[0]) this.points = [];
    if (last && x === last[0]) this.points.pop();
    this.points.push([x, y]);
    if (this.points.length > MOST) this.points = this.points.filter((_, i) => i % 2 === 0);
    this.draw();
  }

  draw() {
    const { canvas, points } = this;
    const ratio = window.devicePixelRatio || 1;
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    if (!w || !points.length) return;
    canvas.width = Math.round(w * ratio);
    canvas.height = Math.round(h * ratio);
    const ctx = canvas.getContext('2d');
    ctx.scale(ratio, ratio);
    const style = getComputedStyle(document.body);
    ctx.fillStyle = style.color;
    ctx.font = '12px system-ui, sans-serif';
    const [x0, x1] = [points[0][0], points.at(-1)[0]];
    const top = Math.max(...points.map((p) => p[1]), 1e-9);
    ctx.fillText(`${this.title}: ${points.at(-1)[1].toPrecision(3)} ${this.unit}, most ${top.toPrecision(3)}`, 2, 12);
    ctx.beginPath();
    points.forEach(([x, y], i) => {
      const px = x1 > x0 ? (w * (x - x0)) / (x1 - x0) : w;
      const py = h - 2 - ((h - 20) * Math.max(y, 0)) / top;
      if (i) ctx.lineTo(px, py);
      else ctx.moveTo(px, py);
    });
    ctx.strokeStyle = style.color;
    ctx.lineWidth = 1.5;
    ctx.stroke();
  }
}
