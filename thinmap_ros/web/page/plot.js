// A small plot of one curve that grows; when it is full, every second point is left out.

const MOST = 600;
const [LEFT, BOTTOM, TOP] = [38, 16, 18];

// The smallest of 1, 2 and 5 times a power of ten that is no less than a number.
export function roundUp(number) {
  const power = 10 ** Math.floor(Math.log10(number));
  return [1, 2, 5, 10].map((step) => step * power).find((step) => step >= number * (1 - 1e-9));
}

export class Plot {
  constructor(canvas, title, unit, unitX) {
    this.canvas = canvas;
    this.title = title;
    this.unit = unit;
    this.unitX = unitX;
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
    const style = getComputedStyle(canvas);
    const [x0, x1] = [points[0][0], points.at(-1)[0]];
    const most = roundUp(Math.max(...points.map((p) => p[1]), 1e-3));
    const place = ([x, y]) => [
      LEFT + (x1 > x0 ? ((w - LEFT - 4) * (x - x0)) / (x1 - x0) : 0),
      h - BOTTOM - ((h - BOTTOM - TOP) * Math.max(y, 0)) / most,
    ];
    ctx.font = '11px system-ui, sans-serif';
    ctx.fillStyle = style.color;
    ctx.strokeStyle = style.getPropertyValue('--line');
    ctx.textBaseline = 'middle';
    ctx.textAlign = 'right';
    for (const y of [0, most / 2, most]) {
      const [, py] = place([x0, y]);
      ctx.fillText(`${Number(y.toPrecision(3))}`, LEFT - 4, py);
      this.curve(ctx, [[LEFT, py], [w - 4, py]]);
    }
    ctx.textBaseline = 'bottom';
    ctx.fillText(`${x1.toFixed(0)} ${this.unitX}`, w - 4, h);
    ctx.textAlign = 'left';
    ctx.fillText(x0.toFixed(0), LEFT, h);
    ctx.textBaseline = 'top';
    ctx.fillText(`${this.title}, ${this.unit}: ${points.at(-1)[1].toPrecision(3)}`, LEFT, 0);
    ctx.strokeStyle = style.getPropertyValue('--first');
    ctx.lineWidth = 1.5;
    this.curve(ctx, points.map(place));
  }

  curve(ctx, places) {
    ctx.beginPath();
    places.forEach(([x, y], i) => (i ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
    ctx.stroke();
  }
}
