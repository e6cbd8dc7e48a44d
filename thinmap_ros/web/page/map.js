// The map on a canvas: tiles, graph, robot. Positions in m, map frame; y points up.

const CELLS = ['--unknown', '--free', '--wall']; // colours of the classes, as the theme has them
export const TINT = 0.55; // of a region over the map

function rgb(colour) {
  return [1, 3, 5].map((i) => parseInt(colour.slice(i, i + 2), 16));
}

const themed = (name) => getComputedStyle(document.documentElement).getPropertyValue(name);

function isInside([x, y], corners) {
  let inside = false;
  corners.forEach(([x1, y1], i) => {
    const [x2, y2] = corners.at(i - 1);
    if (y1 > y !== y2 > y && x < x1 + ((y - y1) * (x2 - x1)) / (y2 - y1)) inside = !inside;
  });
  return inside;
}

async function unpacked(text) {
  const bytes = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream('deflate'));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

function pairs(flat) {
  const points = [];
  for (let i = 0; i + 1 < flat.length; i += 2) points.push([flat[i], flat[i + 1]]);
  return points;
}

export class MapView {
  constructor(canvas, items) {
    this.canvas = canvas;
    this.items = items;
    this.tiles = new Map();
    this.scale = 40;
    this.centre = [0, 0];
    this.follow = false;
    this.showsAll = true; // until somebody moves the map
    this.colours = {}; // by name, as the key says
    this.hidden = new Set(); // layers
    this.chosen = null; // id of a region
    this.sketch = null; // what is being drawn: {from, to} or {corners}
    this.onscale = () => {}; // receives pixels of a metre
    this.isDirty = true;
    new ResizeObserver(() => (this.showsAll ? this.fit() : null, this.redraw())).observe(canvas);
    const frame = () => {
      if (this.isDirty) this.draw();
      requestAnimationFrame(frame);
    };
    requestAnimationFrame(frame);
  }

  redraw() {
    this.isDirty = true;
  }

  colour(name) {
    return this.colours[name] ?? '#777777';
  }

  newMap() {
    this.tiles.clear();
    this.redraw();
  }

  async setTile(name, text) {
    const tile = this.tiles.get(name) ?? { version: 0, cells: null, image: null };
    const version = ++tile.version;
    this.tiles.set(name, tile);
    const cells = await unpacked(text);
    if (version !== tile.version) return; // a newer one was unpacked meanwhile
    tile.cells = cells;
    tile.image = null;
    if (this.showsAll) this.fit();
    this.redraw();
  }

  newTheme() {
    for (const tile of this.tiles.values()) tile.image = null;
    this.redraw();
  }

  imageOf(tile, side) {
    if (tile.image || !tile.cells) return tile.image;
    const colours = CELLS.map((name) => rgb(themed(name)));
    const image = new ImageData(side, side);
    tile.cells.forEach((kind, i) => {
      const [r, g, b] = colours[kind];
      image.data.set([r, g, b, 255], 4 * i);
    });
    tile.image = document.createElement('canvas');
    tile.image.width = tile.image.height = side;
    tile.image.getContext('2d').putImageData(image, 0, 0);
    return tile.image;
  }

  // Where a point of the screen (CSS pixels of the canvas) is in the map, and back.
  toMap(px, py) {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    return [this.centre[0] + (px - w / 2) / this.scale, this.centre[1] - (py - h / 2) / this.scale];
  }

  toScreen(x, y) {
    const { clientWidth: w, clientHeight: h } = this.canvas;
    return [w / 2 + (x - this.centre[0]) * this.scale, h / 2 - (y - this.centre[1]) * this.scale];
  }

  zoom(factor, px = this.canvas.clientWidth / 2, py = this.canvas.clientHeight / 2) {
    this.showsAll = false;
    const [x, y] = this.toMap(px, py);
    this.scale = Math.min(Math.max(this.scale * factor, 0.5), 800);
    const [nx, ny] = this.toMap(px, py);
    this.centre = [this.centre[0] + x - nx, this.centre[1] + y - ny];
    this.redraw();
  }

  // All that is known into view, as it grows.
  fit() {
    this.showsAll = true;
    const head = this.items.get('map');
    if (!head) return;
    const edge = head.side * head.resolution;
    let [west, south, east, north] = [Infinity, Infinity, -Infinity, -Infinity];
    for (const [name, tile] of this.tiles) {
      if (!tile.cells) continue;
      const [row, col] = name.split('/').slice(1).map(Number);
      tile.cells.forEach((kind, i) => {
        if (!kind) return;
        const x = head.x + col * edge + (i % head.side) * head.resolution;
        const y = head.y + row * edge + Math.floor(i / head.side) * head.resolution;
        west = Math.min(west, x);
        east = Math.max(east, x);
        south = Math.min(south, y);
        north = Math.max(north, y);
      });
    }
    if (west > east) return;
    const { clientWidth: w, clientHeight: h } = this.canvas;
    this.scale = Math.max(0.5, Math.min(w / (east - west + 2), (h - 60) / (north - south + 2)));
    this.centre = [(west + east) / 2, (south + north) / 2];
    this.redraw();
  }

  draw() {
    this.isDirty = false;
    const { canvas } = this;
    const ratio = window.devicePixelRatio || 1;
    const [w, h] = [canvas.clientWidth, canvas.clientHeight];
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      canvas.width = Math.round(w * ratio);
      canvas.height = Math.round(h * ratio);
    }
    const robot = this.items.get('robot');
    if (this.follow && robot) this.centre = robot.pose.slice(0, 2);
    const ctx = canvas.getContext('2d');
    ctx.setTransform(ratio, 0, 0, ratio, 0, 0);
    ctx.clearRect(0, 0, w, h);
    const s = this.scale * ratio;
    ctx.setTransform(s, 0, 0, -s, (w / 2) * ratio - this.centre[0] * s, (h / 2) * ratio + this.centre[1] * s);
    this.px = 1 / this.scale; // a pixel, in m
    this.onscale(this.scale);
    this.drawTiles(ctx);
    for (const [layer, drawn] of this.layers) if (!this.hidden.has(layer)) drawn.call(this, ctx);
    this.drawOthers(ctx);
    if (robot) this.drawRobot(ctx, robot);
    this.drawSketch(ctx);
  }

  // From the lowest to the highest.
  get layers() {
    return [
      ['regions', this.drawRegions],
      ['keep out', this.drawKeepOut],
      ['graph', this.drawGraph],
      ['path', this.drawPath],
      ['plan', this.drawPlan],
      ['laser', this.drawLaser],
      ['end nodes', this.drawEndNodes],
    ];
  }

  // Id of the region at a place; null for none.
  regionAt(place) {
    const regions = this.hidden.has('regions') ? [] : this.items.get('regions') ?? [];
    return regions.find(({ outline }) => isInside(place, pairs(outline)))?.id ?? null;
  }

  drawTiles(ctx) {
    const head = this.items.get('map');
    if (!head) return;
    const edge = head.side * head.resolution;
    ctx.imageSmoothingEnabled = false;
    for (const [name, tile] of this.tiles) {
      const image = this.imageOf(tile, head.side);
      if (!image) continue;
      const [row, col] = name.split('/').slice(1).map(Number);
      ctx.drawImage(image, head.x + col * edge, head.y + row * edge, edge, edge);
    }
  }

  line(ctx, points, colour, width, isClosed = false) {
    if (points.length < 2) return;
    ctx.beginPath();
    points.forEach(([x, y], i) => (i ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
    if (isClosed) ctx.closePath();
    ctx.strokeStyle = colour;
    ctx.lineWidth = width * this.px;
    ctx.lineJoin = 'round';
    ctx.stroke();
  }

  dot(ctx, x, y, radius, colour) {
    ctx.beginPath();
    ctx.arc(x, y, radius * this.px, 0, 2 * Math.PI);
    ctx.fillStyle = colour;
    ctx.fill();
  }

  text(ctx, x, y, words, size = 12) {
    ctx.save();
    ctx.translate(x, y);
    ctx.scale(this.px, -this.px);
    ctx.font = `${size}px system-ui, sans-serif`;
    ctx.textAlign = 'center';
    ctx.lineWidth = 3;
    const dark = document.documentElement.classList.contains('dark');
    ctx.strokeStyle = dark ? '#1d2023' : '#ffffff';
    ctx.fillStyle = dark ? '#ffffff' : '#000000';
    ctx.strokeText(words, 0, 0);
    ctx.fillText(words, 0, 0);
    ctx.restore();
  }

  drawRegions(ctx) {
    const dark = document.documentElement.classList.contains('dark');
    for (const region of this.items.get('regions') ?? []) {
      const points = pairs(region.outline);
      ctx.globalAlpha = TINT;
      // What is black inside of a region stays black.
      ctx.globalCompositeOperation = dark ? 'source-over' : 'multiply';
      ctx.beginPath();
      points.forEach(([x, y], i) => (i ? ctx.lineTo(x, y) : ctx.moveTo(x, y)));
      ctx.closePath();
      ctx.fillStyle = region.colour;
      ctx.fill();
      ctx.globalAlpha = 1;
      ctx.globalCompositeOperation = 'source-over';
      if (region.id === this.chosen) this.line(ctx, points, themed('--first'), 2, true);
      if (this.scale > 12) {
        this.text(ctx, ...region.center, `${region.name}, ${region.area} m²`);
      }
    }
  }

  drawKeepOut(ctx) {
    const colour = this.colour('keep out');
    for (const { corners, is_wall: isWall } of this.items.get('keep_out') ?? []) {
      this.line(ctx, pairs(corners), colour, isWall ? 4 : 2, !isWall);
      ctx.globalAlpha = 0.35;
      ctx.fillStyle = colour;
      if (!isWall) ctx.fill('evenodd');
      ctx.globalAlpha = 1;
    }
  }

  drawGraph(ctx) {
    const graph = this.items.get('graph');
    if (!graph) return;
    for (const id of graph.edges) {
      this.line(ctx, pairs(this.items.get(`edge/${id}`) ?? []), this.colour('edge'), 1.5);
    }
    const labels = []; // where there is one, there is no room for another
    for (const [id, kind, x, y] of graph.nodes) {
      this.dot(ctx, x, y, 4, this.colour(`${kind} node`));
      const isFree = labels.every(([lx, ly]) => Math.hypot(x - lx, y - ly) > 24 * this.px);
      if (this.scale <= 35 || !isFree) continue;
      labels.push([x, y]);
      this.text(ctx, x, y + 6 * this.px, `${id}`, 10);
    }
  }

  drawPath(ctx) {
    const pieces = this.items.get('path') ?? 0;
    for (let i = 0; i < pieces; i += 1) {
      const points = pairs(this.items.get(`path/${i}`) ?? []);
      this.line(ctx, points, this.colour('robot and its path'), 2);
    }
  }

  drawPlan(ctx) {
    this.line(ctx, pairs(this.items.get('plan') ?? []), this.colour('plan and goal'), 2);
    const goal = this.items.get('goal');
    if (goal) this.arrow(ctx, goal, this.colour('plan and goal'), 26);
  }

  drawLaser(ctx) {
    ctx.fillStyle = this.colour('mapped apart');
    for (const [x, y] of pairs(this.items.get('apart') ?? [])) {
      ctx.fillRect(x - this.px, y - this.px, 2 * this.px, 2 * this.px);
    }
    const laser = this.items.get('laser');
    if (!laser) return;
    const [x, y, theta] = laser.pose;
    const [c, s] = [Math.cos(theta), Math.sin(theta)];
    ctx.fillStyle = this.colour('laser');
    const size = 3 * this.px;
    for (const [px, py] of pairs(laser.points_cm)) {
      const [bx, by] = [px / 100, py / 100];
      ctx.fillRect(x + c * bx - s * by - size / 2, y + s * bx + c * by - size / 2, size, size);
    }
  }

  drawEndNodes(ctx) {
    for (const [, x, y, probability, isTarget] of this.items.get('end_nodes') ?? []) {
      this.dot(ctx, x, y, isTarget ? 8 : 5, this.colour('end node'));
      if (this.scale > 15) this.text(ctx, x, y - 16 * this.px, `p ${probability.toFixed(2)}`, 11);
    }
  }

  arrow(ctx, [x, y, theta], colour, length) {
    const [dx, dy] = [Math.cos(theta) * length * this.px, Math.sin(theta) * length * this.px];
    this.line(ctx, [[x, y], [x + dx, y + dy]], colour, 3);
    this.dot(ctx, x, y, 5, colour);
  }

  drawOthers(ctx) {
    for (const [name, x, y, theta] of this.items.get('robots') ?? []) {
      this.body(ctx, [x, y, theta], this.colour('other robots'));
      this.text(ctx, x, y + 18 * this.px, name);
    }
  }

  drawRobot(ctx, robot) {
    const [x, y] = robot.pose;
    const colour = this.colour('robot and its path');
    this.drawSpread(ctx, x, y, robot.covariance, colour);
    this.body(ctx, robot.pose, colour);
  }

  body(ctx, [x, y, theta], colour) {
    ctx.save();
    ctx.translate(x, y);
    ctx.rotate(theta);
    const size = Math.max(9 * this.px, 0.2);
    ctx.beginPath();
    ctx.moveTo(1.4 * size, 0);
    ctx.lineTo(-size, 0.8 * size);
    ctx.lineTo(-0.5 * size, 0);
    ctx.lineTo(-size, -0.8 * size);
    ctx.closePath();
    ctx.fillStyle = colour;
    ctx.fill();
    ctx.strokeStyle = '#000000';
    ctx.lineWidth = this.px;
    ctx.stroke();
    ctx.restore();
  }

  // Ellipse of two standard deviations.
  drawSpread(ctx, x, y, [xx, xy, yy], colour) {
    const mean = (xx + yy) / 2;
    const root = Math.hypot((xx - yy) / 2, xy);
    const [a, b] = [mean + root, Math.max(mean - root, 0)].map((v) => 2 * Math.sqrt(v));
    ctx.beginPath();
    ctx.ellipse(x, y, Math.min(a, 1e4), Math.min(b, 1e4), 0.5 * Math.atan2(2 * xy, xx - yy), 0, 2 * Math.PI);
    ctx.strokeStyle = colour;
    ctx.lineWidth = 1.5 * this.px;
    ctx.stroke();
  }

  drawSketch(ctx) {
    if (!this.sketch) return;
    const { from, to, corners, theta, isOpen } = this.sketch;
    if (corners) {
      const colour = this.colour(this.sketch.colour ?? 'limit of the exploration');
      this.line(ctx, corners, colour, 2, !isOpen);
      for (const [x, y] of corners) this.dot(ctx, x, y, 4, colour);
    } else if (to) {
      this.arrow(ctx, [...from, theta], this.colour('plan and goal'), 40);
    }
  }
}

