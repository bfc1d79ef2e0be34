// States and events in sentences, numbers with their units.

export const MEANING = {
  disconnected: 'No link to the robot. The daemon tries again by itself; nothing is written.',
  observing: 'Reading the robot and predicting how it bends. Nothing is written.',
  armed: 'Allowed to write; waits for the first setpoint that fits.',
  compensating: 'Writing corrected setpoints.',
  holding: 'Taking the offset out; the arm comes to rest.',
  fault: 'Nothing is written. A person has to look and acknowledge (gapbridge disarm).',
};

export function number(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return '–';
  if (value === 0) return '0';
  const size = Math.abs(value);
  if (size >= 1000) return Math.round(value).toLocaleString('en').replace(/,/g, '\u202f');
  const places = Math.max(0, digits - 1 - Math.floor(Math.log10(size)));
  return value.toFixed(Math.min(places, 6));
}

export function fixed(value, digits) {
  return value.toFixed(digits).replace(/^-(?=[0.]+$)/, ''); // no negative zero
}

export function count(value) {
  if (!Number.isFinite(value)) return '–';
  return Math.round(value).toLocaleString('en').replace(/,/g, '\u202f');
}

export function duration(seconds) {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return '–';
  if (seconds < 1e-3) return `${number(1e6 * seconds)} µs`;
  if (seconds < 1) return `${number(1e3 * seconds)} ms`;
  if (seconds < 60) return `${number(seconds)} s`;
  if (seconds < 3600) return `${Math.floor(seconds / 60)} min ${Math.floor(seconds % 60)} s`;
  if (seconds < 86400) return `${Math.floor(seconds / 3600)} h ${Math.floor((seconds % 3600) / 60)} min`;
  return `${Math.floor(seconds / 86400)} d ${Math.floor((seconds % 86400) / 3600)} h`;
}

export function clock(epoch) {
  return new Date(1000 * epoch).toLocaleTimeString('en-GB');
}

const KNOWN = new Set(['time', 'monotonic', 'sequence', 'kind', 'from', 'to', 'cause', 'detail',
  'cycle', 'session', 'text']);

const SENTENCES = new Set(['failure', 'fault', 'ended', 'reason']);

// a path by its last part: the rest only says where on that machine
const shorter = (message) => message.replace(/(?:\/[^\s;,:/]+){2,}\/([^\s;,:/]+)/g, '…/$1').slice(0, 600);

export function describe(event) {
  const found = { title: event.kind || 'event', text: '', look: '' };
  if (event.to) {
    const to = String(event.to).toLowerCase();
    found.title = to;
    found.look = `to-${to}`;
    found.text = shorter([event.cause, event.detail].filter(Boolean).join(': '));
    return found;
  }
  // the detail is a sentence already; what has none is shown key by key
  const parts = event.detail ? [event.detail] : [];
  for (const [key, value] of Object.entries(event.detail ? {} : event)) {
    if (KNOWN.has(key) || value === null || value === '') continue;
    const plain = typeof value === 'object' ? JSON.stringify(value) : String(value);
    parts.push(SENTENCES.has(key) ? plain : `${key.replace(/_/g, ' ')} ${plain}`);
  }
  found.text = shorter(parts.join('; '));
  if (['fault', 'refused'].includes(event.kind) || event.failure || event.fault) found.look = 'bad';
  return found;
}
