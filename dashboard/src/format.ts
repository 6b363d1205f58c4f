// Numbers and times as people read them. An unknown number is a dash, never a zero.

export const DASH = '–';

export function count(n: number | null | undefined): string {
  if (n == null || Number.isNaN(n)) return DASH;
  const size = Math.abs(n);
  if (size >= 1e9) return `${(n / 1e9).toFixed(2)} G`;
  if (size >= 1e6) return `${(n / 1e6).toFixed(2)} M`;
  if (size >= 1e4) return `${(n / 1e3).toFixed(1)} k`;
  return String(Math.round(n));
}

export function fixed(n: number | null | undefined, digits: number): string {
  return n == null || Number.isNaN(n) ? DASH : n.toFixed(digits);
}

export function bytes(n: number | null | undefined): string {
  if (n == null) return DASH;
  const units = ['B', 'kB', 'MB', 'GB', 'TB'];
  let unit = 0;
  let size = n;
  while (size >= 1000 && unit < units.length - 1) { size /= 1000; unit += 1; }
  return `${unit === 0 ? size : size.toFixed(size < 10 ? 2 : 1)} ${units[unit]}`;
}

export function percent(part: number, whole: number): string {
  return whole > 0 ? `${Math.floor((100 * part) / whole)} %` : DASH;
}

/** A span of time with two units at most: 2 h 05 min. */
export function span(seconds: number | null | undefined): string {
  if (seconds == null || !Number.isFinite(seconds)) return DASH;
  const s = Math.max(0, seconds);
  if (s < 10) return `${+s.toFixed(1)} s`;
  if (s < 60) return `${Math.round(s)} s`;
  if (s < 3600) return `${Math.floor(s / 60)} min ${pad(Math.floor(s % 60))} s`;
  if (s < 86400) return `${Math.floor(s / 3600)} h ${pad(Math.floor((s % 3600) / 60))} min`;
  return `${Math.floor(s / 86400)} d ${pad(Math.floor((s % 86400) / 3600))} h`;
}

export function range(low: number, high: number): string {
  const a = span(low);
  const b = span(high);
  return a === b ? a : `${a} – ${b}`;
}

/** Time left, as [low, high] seconds. Below a second it is no number: the last report may lag. */
export function left(low: number, high: number): string {
  return high < 1 ? 'about to end' : low < 1 ? `up to ${span(high)}` : range(low, high);
}

/** A line with its long hashes cut to 12 digits. */
export function brief(text: string): string {
  return text.replace(/\b([0-9a-f]{12})[0-9a-f]{20,}\b/g, '$1…');
}

export function clock(unixMs: number): string {
  const d = new Date(unixMs);
  return `${pad(d.getHours())}:${pad(d.getMinutes())}:${pad(d.getSeconds())}`;
}

export function utc(unixMs: number): string {
  return new Date(unixMs).toISOString().replace('T', ' ').replace(/\.\d+Z/, ' UTC');
}

export function metres(n: number): string {
  return n >= 1000 ? `${+(n / 1000).toFixed(1)} km` : n < 1 ? `${+(n * 100).toFixed(1)} cm` : `${+n.toFixed(n < 10 ? 1 : 0)} m`;
}

export function pad(n: number): string {
  return String(n).padStart(2, '0');
}

/** Saves text or bytes as a file on the reader's machine. */
export function save(name: string, content: BlobPart, type: string): void {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(new Blob([content], { type }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 1000);
}
