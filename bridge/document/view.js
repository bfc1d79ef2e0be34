// A 3-D scene of lines on a canvas: drag to turn; click, then scroll to zoom.

export class View {
  constructor(canvas, scene, colour) {
    [this.azimuth, this.elevation] = scene.view;
    this.canvas = canvas;
    this.colour = colour;
    this.zoom = 1;
    this.drag = null;
    this.set(scene);
    canvas.addEventListener('pointerdown', (event) => {
      this.drag = [event.clientX, event.clientY];
      canvas.setPointerCapture(event.pointerId);
    });
    canvas.addEventListener('pointermove', (event) => this.move(event));
    const rest = () => { this.drag = null; };
    canvas.addEventListener('pointerup', rest);
    canvas.addEventListener('pointercancel', rest);
    // before the first click, wheel and vertical swipes scroll the page
    canvas.addEventListener('click', () => canvas.classList.add('active'));
    canvas.addEventListener('blur', () => canvas.classList.remove('active'));
    canvas.addEventListener('pointerleave', () => {
      if (!this.drag) canvas.classList.remove('active');
    });
    canvas.addEventListener('wheel', (event) => {
      if (!canvas.classList.contains('active')) return;
      event.preventDefault();
      this.scale(Math.exp(-event.deltaY / 600));
    }, { passive: false });
    canvas.addEventListener('keydown', (event) => this.key(event));
    new ResizeObserver(() => this.draw()).observe(canvas);
    matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => this.draw());
  }

  // show another scene with the same view and size, unless it needs more space
  set(scene) {
    this.scene = scene;
    const every = scene.paths.flatMap((p) => p.points)
      .concat(scene.arrows.flatMap((a) => a.start.concat(a.end)));
    const low = [0, 1, 2].map((i) => Math.min(...every.map((p) => p[i])));
    const high = [0, 1, 2].map((i) => Math.max(...every.map((p) => p[i])));
    const span = Math.hypot(...high.map((h, i) => h - low[i]));
    if (!this.span || span > this.span || span < 0.5 * this.span) {
      this.middle = low.map((l, i) => (l + high[i]) / 2);
      this.span = span;
    }
    this.draw();
  }

  move(event) {
    if (!this.drag) return;
    this.azimuth -= (event.clientX - this.drag[0]) * 0.008;
    const tilt = this.elevation + (event.clientY - this.drag[1]) * 0.008;
    this.elevation = Math.max(-1.5, Math.min(1.5, tilt));
    this.drag = [event.clientX, event.clientY];
    this.draw();
  }

  scale(factor) {
    this.zoom = Math.max(0.3, Math.min(12, this.zoom * factor));
    this.draw();
  }

  key(event) {
    const turn = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1],
      ArrowDown: [0, -0.1] }[event.key];
    if (turn) {
      this.azimuth += turn[0];
      this.elevation = Math.max(-1.5, Math.min(1.5, this.elevation + turn[1]));
      this.draw();
    } else if (event.key === '+' || event.key === '-') this.scale(event.key === '+' ? 1.2 : 1 / 1.2);
    else if (event.key === 'Escape') this.canvas.classList.remove('active');
    else return;
    event.preventDefault();
  }

  draw() {
    const { canvas, scene } = this, ratio = Math.min(window.devicePixelRatio || 1, 3);
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !height) return;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const pen = canvas.getContext('2d');
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.lineJoin = pen.lineCap = 'round';
    const size = 1.3 * this.zoom * Math.min(width, height) / this.span;
    const [ca, sa] = [Math.cos(this.azimuth), Math.sin(this.azimuth)];
    const [ce, se] = [Math.cos(this.elevation), Math.sin(this.elevation)];
    const at = (point) => {
      const [x, y, z] = point.map((v, i) => v - this.middle[i]);
      return [width / 2 + size * (x * ca + y * sa),
        height / 2 - size * (-x * sa * se + y * ca * se + z * ce)];
    };
    for (const path of scene.paths) {
      pen.strokeStyle = pen.fillStyle = this.colour(path.colour);
      pen.lineWidth = path.width;
      pen.beginPath();
      path.points.map(at).forEach(([x, y]) => pen.lineTo(x, y));
      pen.stroke();
      if (path.dots) for (const point of path.points) {
        pen.beginPath();
        pen.arc(...at(point), path.width / 2 + 1, 0, 7);
        pen.fill();
      }
    }
    for (const arrows of scene.arrows) {
      pen.strokeStyle = pen.fillStyle = this.colour(arrows.colour);
      pen.lineWidth = 1.6;
      arrows.start.forEach((start, i) => this.arrow(pen, at(start), at(arrows.end[i])));
    }
    let left = 8;
    pen.font = '13px system-ui, sans-serif';
    for (const [text, colour] of scene.legend) {
      pen.fillStyle = this.colour(colour);
      pen.fillRect(left, 9, 11, 4);
      pen.fillStyle = this.colour('soft');
      pen.fillText(text, left + 16, 15);
      left += 32 + pen.measureText(text).width;
    }
    canvas.dataset.drawn = 'yes';
  }

  arrow(pen, start, end) {
    const along = [end[0] - start[0], end[1] - start[1]], long = Math.hypot(...along);
    pen.beginPath();
    pen.moveTo(...start);
    pen.lineTo(...end);
    pen.stroke();
    if (long < 1) return;
    const head = Math.min(7, 0.4 * long), [x, y] = along.map((v) => v / long * head);
    pen.beginPath();
    pen.moveTo(...end);
    pen.lineTo(end[0] - x - 0.45 * y, end[1] - y + 0.45 * x);
    pen.lineTo(end[0] - x + 0.45 * y, end[1] - y - 0.45 * x);
    pen.fill();
  }
}
