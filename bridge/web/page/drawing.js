// Lines over time and a histogram, on canvas. Nothing here knows what is drawn.

const LEFT = 46, RIGHT = 8, TOP = 8, BOTTOM = 26;

function prepared(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 3);
  const width = canvas.clientWidth, height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const pen = canvas.getContext('2d');
  pen.setTransform(ratio, 0, 0, ratio, 0, 0);
  pen.clearRect(0, 0, width, height);
  pen.font = '11px system-ui, sans-serif';
  pen.lineJoin = 'round';
  return [pen, width, height];
}

let styles = null;
export function colour(name) {
  styles = styles || getComputedStyle(document.documentElement);
  return styles.getPropertyValue(`--${name}`).trim();
}
export function forgetColours() { styles = null; }

// Points, the newest one last, of the last seconds; not those from before a clock was set back.
export function recent(points, seconds) {
  if (!points.length) return points;
  const newest = points[points.length - 1][0];
  const outside = (p) => p[0] < newest - seconds || p[0] > newest + 1;
  return points.some(outside) ? points.filter((p) => !outside(p) && p[0] <= newest) : points;
}

function steps(low, high, about) {
  const raw = (high - low) / about;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((f) => f * power).find((s) => s >= raw);
  const found = [];
  for (let v = Math.ceil(low / step) * step; v <= high + step * 1e-6; v += step) found.push(v);
  return [found, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
}

export class Lines {
  // series: [{column, colour, dashed}]; band: the limit to both sides of zero, or null
  constructor(canvas, series, scale) {
    this.canvas = canvas;
    this.series = series;
    this.scale = scale;
    this.band = null;
    this.wholeBand = false;
    this.least = 0.1;  // smallest height of the range, in units drawn
    this.pointer = null;
    const at = (event) => { this.pointer = event.clientX - canvas.getBoundingClientRect().left; };
    canvas.addEventListener('pointermove', at);
    canvas.addEventListener('pointerdown', at);
    canvas.addEventListener('pointerleave', () => { this.pointer = null; });
  }

  range(points) {
    let low = Infinity, high = -Infinity;
    for (const { column } of this.series) {
      for (const point of points) {
        const value = point[column];
        if (value === null) continue;
        if (value < low) low = value;
        if (value > high) high = value;
      }
    }
    if (low > high) [low, high] = [0, 0];
    [low, high] = [low * this.scale, high * this.scale];
    const middle = (low + high) / 2;
    const half = Math.max((high - low) / 2 * 1.15, this.least / 2);
    [low, high] = [middle - half, middle + half];
    if (this.band !== null && this.wholeBand) {
      const b = this.band * this.scale * 1.08;
      [low, high] = [Math.min(low, -b), Math.max(high, b)];
    }
    return [low, high];
  }

  draw(points, from, to) {
    const [pen, width, height] = prepared(this.canvas);
    const [low, high] = this.range(points);
    const bottom = height - BOTTOM;
    const x = (t) => LEFT + (t - from) / (to - from) * (width - LEFT - RIGHT);
    const y = (v) => bottom - (v - low) / (high - low) * (bottom - TOP);
    this.drawBand(pen, y, width, bottom);
    this.drawGrid(pen, low, high, y, width, from, to, x, height);
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, TOP - 2, width - LEFT - RIGHT, bottom - TOP + 4);
    pen.clip();
    for (const line of this.series) this.drawLine(pen, points, line, x, y);
    pen.restore();
    this.drawStates(pen, points, x, bottom, to);
    this.drawPointer(pen, points, x, y, width, bottom, from, to);
  }

  drawBand(pen, y, width, bottom) {
    if (this.band === null) return;
    const b = this.band * this.scale;
    const top = Math.max(TOP, Math.min(bottom, y(b))), under = Math.max(TOP, Math.min(bottom, y(-b)));
    pen.fillStyle = colour('band');
    pen.fillRect(LEFT, top, width - LEFT - RIGHT, under - top);
    pen.strokeStyle = colour('band-line');
    pen.setLineDash([4, 3]);
    for (const v of [b, -b]) {
      if (y(v) < TOP - 0.5 || y(v) > bottom + 0.5) continue;
      pen.beginPath();
      pen.moveTo(LEFT, y(v));
      pen.lineTo(width - RIGHT, y(v));
      pen.stroke();
    }
    pen.setLineDash([]);
  }

  drawGrid(pen, low, high, y, width, from, to, x, height) {
    pen.strokeStyle = colour('grid');
    pen.fillStyle = colour('soft');
    pen.lineWidth = 1;
    pen.textAlign = 'right';
    pen.textBaseline = 'middle';
    const [values, places] = steps(low, high, 4);
    for (const value of values) {
      const at = Math.round(y(value)) + 0.5;
      pen.beginPath();
      pen.moveTo(LEFT, at);
      pen.lineTo(width - RIGHT, at);
      pen.stroke();
      pen.fillText((Math.abs(value) < 1e-12 ? 0 : value).toFixed(Math.min(places, 4)), LEFT - 6, at);
    }
    pen.textAlign = 'center';
    pen.textBaseline = 'alphabetic';
    const span = to - from, every = span > 400 ? 120 : span > 120 ? 60 : span > 50 ? 15 : 5;
    for (let back = 0; back < span - every / 3; back += every) {
      const text = back === 0 ? 'now' : back % 60 === 0 ? `−${back / 60} min` : `−${back} s`;
      pen.textAlign = back === 0 ? 'right' : 'center';
      pen.fillText(text, back === 0 ? width - RIGHT : x(to - back), height - 4);
    }
  }

  drawLine(pen, points, line, x, y) {
    pen.strokeStyle = colour(line.colour);
    pen.lineWidth = line.dashed ? 1.4 : 1.8;
    pen.setLineDash(line.dashed ? [5, 4] : []);
    pen.globalAlpha = line.dashed ? 0.95 : 0.9;
    pen.beginPath();
    let last = null, low = null, high = null, pixel = null;
    const flush = () => {
      if (low === null || low === high) return;
      pen.lineTo(pixel, y(low * this.scale));
      pen.lineTo(pixel, y(high * this.scale));
    };
    for (const point of points) {
      const value = point[line.column];
      if (value === null) { flush(); last = low = high = null; continue; }
      const gap = last !== null && point[0] - last > Math.max(1.0, 4 * (point.span || 0));
      const at = Math.round(2 * x(point[0])) / 2;
      if (last === null || gap) {
        flush();
        pen.moveTo(at, y(value * this.scale));
        [low, high, pixel] = [value, value, at];
      } else if (at === pixel) {
        [low, high] = [Math.min(low, value), Math.max(high, value)];
      } else {
        flush();
        pen.lineTo(at, y(value * this.scale));
        [low, high, pixel] = [value, value, at];
      }
      last = point[0];
    }
    flush();
    pen.stroke();
    pen.setLineDash([]);
    pen.globalAlpha = 1;
  }

  drawStates(pen, points, x, bottom, to) {
    let begin = 0;
    for (let i = 1; i <= points.length; i++) {
      const before = points[i - 1];
      const gap = i < points.length && points[i][0] - before[0] > 1.0;
      if (i < points.length && points[i].state === before.state && !gap) continue;
      const end = i < points.length && !gap ? points[i][0] : Math.min(before[0] + 0.05, to);
      pen.fillStyle = colour(before.state || 'unknown');
      pen.fillRect(x(points[begin][0]), bottom + 3, Math.max(x(end) - x(points[begin][0]), 1), 4);
      begin = i;
    }
  }

  drawPointer(pen, points, x, y, width, bottom, from, to) {
    if (this.pointer === null || !points.length) return;
    const time = from + (this.pointer - LEFT) / (width - LEFT - RIGHT) * (to - from);
    let near = points[0];
    for (const p of points) if (Math.abs(p[0] - time) < Math.abs(near[0] - time)) near = p;
    const at = x(near[0]);
    if (at < LEFT) return;
    pen.strokeStyle = colour('soft');
    pen.beginPath();
    pen.moveTo(at, TOP);
    pen.lineTo(at, bottom);
    pen.stroke();
    const rows = [[null, new Date(1000 * near[0]).toLocaleTimeString('en-GB')]];
    for (const line of this.series) {
      const value = near[line.column];
      if (value !== null) rows.push([line, `${line.name} ${(value * this.scale).toFixed(3)}`]);
    }
    const wide = Math.max(...rows.map((r) => pen.measureText(r[1]).width)) + 26;
    const left = at + wide + 12 > width ? at - wide - 8 : at + 8;
    pen.fillStyle = colour('card');
    pen.strokeStyle = colour('line');
    pen.beginPath();
    pen.roundRect(left, TOP, wide, 15 * rows.length + 8, 6);
    pen.fill();
    pen.stroke();
    pen.textAlign = 'left';
    pen.textBaseline = 'middle';
    rows.forEach(([line, text], i) => {
      pen.fillStyle = line ? colour(line.colour) : colour('soft');
      if (line) pen.fillRect(left + 7, TOP + 11 + 15 * i, 8, line.dashed ? 1 : 3);
      pen.fillText(text, left + (line ? 20 : 7), TOP + 12 + 15 * i);
    });
  }
}

export function drawHistogram(canvas, edges, sets, marks) {
  // sets: [{counts, colour}], heights as shares (square root: rare ones must be seen); x is log
  const [pen, width, height] = prepared(canvas);
  const bottom = height - 18, left = 6, right = width - 6;
  const totals = sets.map((s) => s.counts.reduce((a, b) => a + b, 0));
  let first = edges.length, final = 0;
  for (const s of sets) s.counts.forEach((c, i) => {
    if (c) { first = Math.min(first, i); final = Math.max(final, i + 1); }
  });
  for (const mark of marks) {
    const i = edges.findIndex((e) => e >= mark.at);
    if (i > 0) { first = Math.min(first, i - 1); final = Math.max(final, i + 1); }
  }
  if (first > final) return;
  first = Math.max(first - 1, 0);
  final = Math.min(final + 1, edges.length - 1);
  const span = Math.log(edges[final] / edges[first]);
  const x = (v) => left + Math.log(v / edges[first]) / span * (right - left);
  pen.fillStyle = colour('soft');
  pen.strokeStyle = colour('grid');
  pen.textAlign = 'center';
  for (let decade = -5; decade <= 0; decade++) {
    for (const f of [1, 2, 5]) {
      const v = f * 10 ** decade;
      if (v < edges[first] * 0.999 || v > edges[final] * 1.001) continue;
      pen.beginPath();
      pen.moveTo(x(v), TOP);
      pen.lineTo(x(v), bottom);
      pen.stroke();
      const text = v < 0.9e-3 ? `${Math.round(1e6 * v)} µs` : `${Math.round(1e3 * v)} ms`;
      if (x(v) > 18 && x(v) < width - 18 && (span < 5 || f === 1)) pen.fillText(text, x(v), height - 4);
    }
  }
  let most = 0;
  sets.forEach((s, k) => s.counts.forEach((c) => { most = Math.max(most, c / Math.max(totals[k], 1)); }));
  sets.forEach((s, k) => {
    pen.fillStyle = colour(s.colour);
    pen.globalAlpha = 0.75;
    s.counts.forEach((c, i) => {
      if (!c) return;
      const tall = Math.max(Math.sqrt(c / totals[k] / most) * (bottom - TOP), 1.5);
      pen.fillRect(x(edges[i]) + 0.5, bottom - tall, Math.max(x(edges[i + 1]) - x(edges[i]) - 1, 1), tall);
    });
    pen.globalAlpha = 1;
  });
  for (const mark of marks) {
    pen.strokeStyle = colour('fault');
    pen.fillStyle = colour('fault');
    pen.setLineDash([3, 3]);
    pen.beginPath();
    pen.moveTo(x(mark.at), TOP);
    pen.lineTo(x(mark.at), bottom);
    pen.stroke();
    pen.setLineDash([]);
    pen.textAlign = x(mark.at) > width / 2 ? 'right' : 'left';
    pen.fillText(mark.name, x(mark.at) + (x(mark.at) > width / 2 ? -5 : 5), TOP + 10);
  }
}
