// The page: takes the daemon's messages, fills in texts and figures, draws.
import { MEANING, clock, count, duration, describe, fixed, number } from './messages.js';
import { Lines, colour, drawHistogram, forgetColours, recent } from './drawing.js';
import { View } from './view.js';

const $ = (id) => document.getElementById(id);
const KEPT = 600;  // s
const SILENT = 3000;  // ms without a message after which the connection counts as lost
const AGAIN = 700;  // ms before the next try

const seen = { about: null, now: null, status: {}, timing: null, events: [], points: [] };
let column = {}, span = 60, source = null, heard = 0, lostSince = null, offset = 0;

const AXES = ['x', 'y', 'z'];
const plots = {};

function makePlots() {
  const lines = (names, dashed, word) => names.map((name, i) => (
    { column: column[name], colour: AXES[i], dashed, name: `${word}${AXES[i]}` }));
  const limits = seen.about.limits;
  const make = (id, series, scale, band, least) => {
    plots[id] = plots[id] || new Lines($(id), series, scale);
    Object.assign(plots[id], { series, scale, band, least });
  };
  make('offset', lines(['offset_x', 'offset_y', 'offset_z'], false, ''), 1e3, limits.offset, 0.1);
  make('rotation', lines(['offset_rx', 'offset_ry', 'offset_rz'], false, ''), 1e3,
    limits.offset_rotation, 0.2);
  const both = (kind) => [
    ...lines(AXES.map((a) => `measured_${kind}${a}`), false, ''),
    ...lines(AXES.map((a) => `predicted_${kind}${a}`), true, 'predicted '),
  ];
  make('force', both('f'), 1, null, 2);
  make('torque', both('m'), 1, null, 0.5);
}

// -- messages ------------------------------------------------------------------------------------

function hello(data) {
  const { now, status, timing, events, ...about } = data;
  seen.about = about;
  column = Object.fromEntries(about.columns.map((name, i) => [name, i]));
  // the daemon's events, and those of the run before that this page has seen
  const known = new Set(events.map(key));
  seen.events = [...seen.events.filter((e) => !known.has(key(e))), ...events].slice(-200);
  Object.assign(seen, { status, timing });
  makePlots();
  tick({ ...now, points: [] });
  showAbout();
  showEvents();
  showTiming();
  fetchHistory();
}

const key = (event) => `${event.time}/${event.sequence}`;

function take(points) {
  for (const point of points) {
    point.state = seen.about.states[point[1]] || 'unknown';
    seen.points.push(point);
  }
  seen.points = recent(seen.points, KEPT);
}

async function fetchHistory() {
  let found;
  try {
    const answer = await fetch(`history?seconds=${KEPT}&points=2000`);
    if (!answer.ok) return;
    found = await answer.json();
  } catch { return; }
  // what the page has seen itself is finer, and older than a restart of the daemon's processes
  const own = seen.points, first = found.points.length ? found.points[0][0] : Infinity;
  const start = own.length ? own[0][0] : Infinity;
  const gaps = (p) => p[0] < start || !own.some((o) => Math.abs(o[0] - p[0]) < 0.6);
  const older = found.points.filter(gaps);
  older.forEach((p) => { p.state = seen.about.states[p[1]] || 'unknown'; p.span = KEPT / 2000; });
  seen.points = [...own, ...older].sort((a, b) => a[0] - b[0]);
  if (first === Infinity) seen.points = own;
}

function tick(data) {
  const { points, ...now } = data;
  offset = now.time - Date.now() / 1000;
  seen.now = now;
  take(points);
  showState();
  showFigures();
  showGauges();
}

// -- texts and figures ---------------------------------------------------------------------------

function text(element, message) {
  if (element.textContent !== message) element.textContent = message;
}

function showAbout() {
  const about = seen.about;
  text($('cell'), about.cell);
  text($('about'), `${about.joints} joints over ${about.driver} at ${number(about.rate)} Hz`);
  text($('session'), `Session ${about.session}.`);
  $('path').replaceChildren(...about.states.map((name) => {
    const item = document.createElement('li');
    item.textContent = name;
    item.dataset.state = name;
    return item;
  }));
}

function showState() {
  const { state, why, phase } = seen.now;
  document.body.dataset.state = state;
  text($('state'), state);
  const status = seen.status;
  const cause = [why.cause, why.detail].filter(Boolean).join(': ') || status.why || '';
  // a loop that starts again because one has ended says why, and not that it starts
  const starting = state === 'disconnected' && phase === 'starting' && !cause;
  text($('meaning'), starting ? 'The loop is starting.' : MEANING[state] || '');
  const since = why.time || status.since;
  const parts = [];
  if (since) parts.push(`since ${clock(since)} (${duration(seen.now.time - since)})`);
  if (cause) parts.push(`because: ${cause}`);
  if (status.armed_by && ['armed', 'compensating'].includes(state)) {
    parts.push(`armed by ${status.armed_by}`);
  }
  if (status.latched) parts.push(`latched: ${status.latched}`);
  if (status.correction && status.correction.detail) parts.push(status.correction.detail);
  text($('why'), parts.join(', '));
  document.title = `${state} – ${seen.about.cell}`;
  for (const item of $('path').children) {
    if (item.dataset.state === state) item.setAttribute('aria-current', 'step');
    else item.removeAttribute('aria-current');
  }
}

const tiles = new Map();
function tile(name, value, unit = '', bad = false) {
  let parts = tiles.get(name);
  if (!parts) {
    const box = document.createElement('div'), label = document.createElement('span');
    const figure = document.createElement('b'), small = document.createElement('small');
    const held = document.createTextNode('');
    label.textContent = name;
    figure.append(held, small);
    box.append(label, figure);
    $('figures').append(box);
    parts = { box, held, small };
    tiles.set(name, parts);
  }
  if (parts.held.data !== value) parts.held.data = value;
  text(parts.small, unit);
  parts.box.classList.toggle('bad', bad);
}

function showFigures() {
  const now = seen.now, wanted = seen.about.rate, age = seen.timing && seen.timing.age;
  const slow = now.rate < 0.95 * wanted;
  tile('rate', number(now.rate), `of ${number(wanted)} Hz`, slow);
  const silence = now.silence === null ? null : Math.max(now.silence, 0);
  tile('last state', silence === null ? 'never' : silence < 1 ? 'now' : duration(silence),
    silence !== null && silence >= 1 ? 'ago' : '', silence === null || silence > 1);
  tile('age, 99 %', age && age.p99 !== null ? duration(age.p99) : '–');
  tile('cycles', count(now.cycles));
  const share = now.missed / Math.max(now.cycles + now.missed, 1);
  tile('missed', count(now.missed), `${(100 * share).toFixed(2)} %`, share > 0.002);
  tile('late', count(now.late));
  tile('setpoints sent', count(now.written));
  const held = Object.values(now.clamped).reduce((a, b) => a + b, 0);
  tile('clamped', count(held));
}

function gauge(id, size, limit, unit) {
  const share = limit > 0 ? size / limit : 0, bar = $(id);
  bar.style.width = `${Math.min(100 * share, 100).toFixed(1)}%`;
  bar.className = share > 0.97 ? 'full' : share > 0.75 ? 'high' : '';
  text($(`${id}-text`), `${number(1e3 * size)} of ${number(1e3 * limit)} ${unit} (${Math.round(100 * share)} %)`);
}

function showGauges() {
  const point = seen.points[seen.points.length - 1];
  if (!point) return;
  const size = (names) => Math.hypot(...names.map((name) => point[column[name]] || 0));
  const limits = seen.about.limits;
  gauge('gauge-offset', size(['offset_x', 'offset_y', 'offset_z']), limits.offset, 'mm');
  gauge('gauge-rotation', size(['offset_rx', 'offset_ry', 'offset_rz']), limits.offset_rotation, 'mrad');
  text($('offset-caption'), ['compensating', 'holding'].includes(seen.now.state)
    ? 'mm in base; the shaded range is the envelope that no setpoint leaves'
    : 'mm in base, what would be corrected: nothing is written now; shaded: the envelope');
  text($('force-caption'), seen.now.sensor === 'ft_raw_wrench'
    ? 'N, flange sensor and axes; predicted: weight of the payload and pull on the tool'
    : 'N, pull on the tool in base; no flange sensor here, so nothing to predict');
}

let view = null;
function showArm(arm) {
  if (view) view.set(arm.scene);
  else view = new View($('arm'), arm.scene, colour);
  text($('arm-caption'), arm.factor > 1 ? `bend drawn ${count(arm.factor)} times larger` : '');
  const along = (values, scale, digits) => values.map((v) => fixed(scale * v, digits)).join(', ');
  $('arm-figures').replaceChildren(
    row('TCP in base, x, y, z', `${along(arm.tcp, 1e3, 1)} mm`),
    row('rotation vector', `${along(arm.rotation, 1, 4)} rad`),
    row('bend at the tool', `${number(1e3 * arm.bend)} mm`),
    row(arm.declared ? 'load, as the controller has it' : 'load, as the cell has it',
      `${number(arm.mass)} kg at ${along(arm.cog, 1e3, 0)} mm`),
    row('pull on the tool', `${number(arm.force)} N`),
  );
  $('joints').replaceChildren(...arm.q.map((angle, i) => {
    const line = document.createElement('tr'), warm = arm.temperature[i];
    const texts = [`${i + 1}`, `${fixed(angle * 180 / Math.PI, 2)}°`,
      warm === null ? '–' : `${warm.toFixed(1)} °C`];
    line.append(...texts.map((word) => {
      const cell = document.createElement('td');
      cell.textContent = word;
      return cell;
    }));
    return line;
  }));
}

function row(name, value, bad = false) {
  const box = document.createElement('div'), term = document.createElement('dt');
  const detail = document.createElement('dd');
  term.textContent = name;
  detail.textContent = value;
  if (bad) box.className = 'bad';
  box.append(term, detail);
  return box;
}

function showHealth() {
  const { status, now } = seen, rows = [];
  const loop = status.loop || {}, link = status.link || {};
  rows.push(row('heartbeat of the loop', now.heartbeat < 0.5 ? 'now' : `${duration(now.heartbeat)} ago`,
    now.heartbeat >= 0.5));
  rows.push(row('loop restarts', count(loop.restarts ?? 0), (loop.restarts ?? 0) > 0));
  const dropped = Object.entries(link.dropped || {}).filter(([, times]) => times > 0);
  if (!dropped.length) rows.push(row('samples dropped', '0'));
  for (const [reason, times] of dropped) {
    rows.push(row(`dropped: ${reason.replace(/_/g, ' ')}`, count(times), true));
  }
  for (const [name, times] of Object.entries(now.clamped)) {
    if (times) rows.push(row(`clamped: ${name.replace(/_/g, ' ')}`, count(times)));
  }
  for (const [name, side] of Object.entries(status.sides || {})) {
    const dead = !side.pid;
    const again = side.restarts ? `, ${side.restarts} restarts` : '';
    rows.push(row(name, `${dead ? 'not running' : 'running'}${again}`, dead || side.restarts > 0));
  }
  for (const [kind, times] of Object.entries(status.counts || {})) {
    if (times && kind !== 'late' && !kind.startsWith('dropped_')) {
      rows.push(row(kind.replace(/_/g, ' '), count(times), true));
    }
  }
  if (status.recording) rows.push(row('recording', String(status.recording).split('/').pop()));
  if (status.lost_rows !== undefined) {
    rows.push(row('cycles not recorded', count(status.lost_rows), status.lost_rows > 0));
  }
  if (now.lost) rows.push(row('cycles this page did not see', count(now.lost)));
  $('health').replaceChildren(...rows);
}

function showTiming() {
  const timing = seen.timing;
  if (!timing) return;
  text($('timing-span'), `last ${Math.round(timing.span)} s; heights by square root`);
  drawHistogram($('timing'), timing.edges, [
    { counts: timing.age.counts, colour: 'bar2' }, { counts: timing.duration.counts, colour: 'bar' },
  ], [{ at: 1 / seen.about.rate, name: 'one cycle' }]);
  $('timing-numbers').replaceChildren(...[
    ['duration', 'work of a cycle'], ['age', 'age of the state behind it'],
  ].map(([name, message]) => {
    const line = document.createElement('tr'), first = document.createElement('td');
    const swatch = document.createElement('i');
    swatch.className = `swatch-${name}`;
    first.append(swatch, message);
    line.append(first, ...['p50', 'p99', 'max'].map((figure) => {
      const cell = document.createElement('td');
      cell.textContent = duration(timing[name][figure]);
      return cell;
    }));
    return line;
  }));
}

function showEvents() {
  const list = seen.events.slice(-100).reverse().map((event) => {
    const { title, text: message, look } = describe(event);
    const item = document.createElement('li');
    item.className = look;
    const time = document.createElement('time');
    time.textContent = clock(event.time);
    const kind = document.createElement('span'), rest = document.createElement('span');
    kind.className = 'kind';
    kind.textContent = title;
    rest.className = 'text';
    rest.textContent = message;
    item.append(time, kind, rest);
    return item;
  });
  if (!list.length) {
    const none = document.createElement('li');
    none.className = 'none';
    none.textContent = 'Nothing has happened yet.';
    list.push(none);
  }
  $('events').replaceChildren(...list);
  text($('events-count'), seen.events.length > 100 ? 'the last 100, newest first' : 'newest first');
}

// -- drawing -------------------------------------------------------------------------------------

let drawnAt = 0;
function draw(at) {
  requestAnimationFrame(draw);
  if (document.hidden || !seen.about || at - drawnAt < (span > 60 ? 400 : 90)) return;
  drawnAt = at;
  const to = document.body.dataset.connection === 'live' || !seen.now
    ? Date.now() / 1000 + offset : seen.now.time;
  const from = to - span;
  let first = seen.points.findIndex((p) => p[0] >= from);
  first = first < 0 ? seen.points.length : Math.max(first - 1, 0);
  const points = seen.points.slice(first);
  for (const plot of Object.values(plots)) plot.draw(points, from, to);
}

// -- connection ----------------------------------------------------------------------------------

function connection(kind, message) {
  document.body.dataset.connection = kind;
  text($('connection').lastElementChild, message);
}

function connect() {
  if (source) source.close();
  heard = Date.now();
  source = new EventSource('events');
  const on = (kind, act) => source.addEventListener(kind, (message) => {
    heard = Date.now();
    if (lostSince !== null || document.body.dataset.connection !== 'live') {
      lostSince = null;
      $('banner').hidden = true;
      connection('live', 'live');
    }
    act(JSON.parse(message.data));
  });
  on('hello', hello);
  on('tick', (data) => { if (seen.about) tick(data); });
  on('arm', showArm);
  on('status', (data) => { seen.status = data; showHealth(); });
  on('timing', (data) => { seen.timing = data; showTiming(); showHealth(); });
  on('event', (data) => { seen.events = [...seen.events, data].slice(-200); showEvents(); });
  source.addEventListener('error', () => lose(source.readyState === EventSource.CLOSED));
}

async function lose(refused) {
  source.close();
  if (lostSince === null) lostSince = Date.now();
  connection('lost', 'no connection');
  text($('banner'), `No connection to the daemon since ${clock(lostSince / 1000)}. What is shown is `
    + 'what was; trying again …');
  $('banner').hidden = false;
  if (refused) {
    const answer = await fetch('status', { method: 'HEAD' }).catch(() => null);
    if (answer && answer.status === 401) { location.reload(); return; }
  }
  setTimeout(connect, AGAIN);
}

setInterval(() => {
  if (source && source.readyState !== EventSource.CLOSED && Date.now() - heard > SILENT) lose(false);
}, 500);

// -- choices -------------------------------------------------------------------------------------

for (const button of document.querySelectorAll('[data-window]')) {
  button.addEventListener('click', () => {
    span = Number(button.dataset.window);
    for (const other of document.querySelectorAll('[data-window]')) {
      other.setAttribute('aria-pressed', String(other === button));
    }
    drawnAt = 0;
  });
}

$('envelope').addEventListener('click', () => {
  const whole = $('envelope').getAttribute('aria-pressed') !== 'true';
  $('envelope').setAttribute('aria-pressed', String(whole));
  for (const id of ['offset', 'rotation']) if (plots[id]) plots[id].wholeBand = whole;
  drawnAt = 0;
});

const THEMES = ['auto', 'light', 'dark'];
function theme(name) {
  if (name === 'auto') delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = name;
  text($('theme'), name[0].toUpperCase() + name.slice(1));
  try { localStorage.setItem('theme', name); } catch { /* a browser that keeps nothing */ }
  forgetColours();
  if (seen.about) showTiming();
}
$('theme').addEventListener('click', () => {
  const at = THEMES.indexOf(document.documentElement.dataset.theme || 'auto');
  theme(THEMES[(at + 1) % THEMES.length]);
});
let stored = null;
try { stored = localStorage.getItem('theme'); } catch { /* a browser that keeps nothing */ }
theme(THEMES.includes(stored) ? stored : 'auto');
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => {
  forgetColours();
  if (seen.about) showTiming();
});
addEventListener('resize', () => { if (seen.about) showTiming(); });

for (const legend of document.querySelectorAll('.legend')) {
  const parts = AXES.map((axis) => [axis, axis]);
  if (legend.dataset.for === 'force') parts.push(['dashed', 'dashed: predicted']);
  for (const [look, message] of parts) {
    const line = document.createElement('i'), label = document.createElement('span');
    line.className = look;
    label.append(line, message);
    legend.append(label);
  }
}

connect();
requestAnimationFrame(draw);
