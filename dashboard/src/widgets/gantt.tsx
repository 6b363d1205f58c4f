// Workers over time, drawn from the events: what each did, and why it did nothing.
import { useEffect, useRef } from 'preact/hooks';
import { useSignal } from '@preact/signals';
import type { Event, Worker } from '../api';
import { css, stateColours } from '../colours';
import { clock, span } from '../format';
import { dark } from '../settings';
import { DONE, FAILED, RUNNING } from '../tasks';

export interface Bar {
  worker: string;
  from: number;
  to: number | null;
  how: 'running' | 'done' | 'failed' | 'lost' | 'idle';
  text: string;
}

/** Pairs the beginnings of attempts with their ends; what lies between two of a worker is idle. */
export function bars(events: Event[], workers: Worker[], now: number): Bar[] {
  const out: Bar[] = [];
  const known = new Map(workers.map((w) => [w.name, w]));
  for (const name of names(events, workers)) {
    const w = known.get(name);
    let open: Event | null = null;
    let idleFrom: number | null = null;
    for (const e of events) {
      if (e.worker !== name) continue;
      const kind = kindOf(e);
      if (kind === 'began') {
        if (idleFrom !== null && e.unix_ms - idleFrom > 1000) out.push({ worker: name, from: idleFrom, to: e.unix_ms, how: 'idle', text: 'idle' });
        open = e;
        idleFrom = null;
      } else if (open && kind !== '' && (e.task === open.task || kind === 'lost')) {
        out.push({ worker: name, from: open.unix_ms, to: e.unix_ms, how: kind === 'revoked' ? 'lost' : kind, text: e.what });
        open = null;
        idleFrom = e.unix_ms;
      }
    }
    if (!w || w.state === 'left') continue;
    if (w.state === 'busy') out.push({ worker: w.name, from: open?.unix_ms ?? w.since_unix_ms, to: null, how: 'running', text: 'running' });
    else if (w.state === 'idle') out.push({ worker: w.name, from: idleFrom ?? w.since_unix_ms, to: now, how: 'idle', text: w.idle_reason });
    else if (w.state === 'lost') out.push({ worker: w.name, from: w.heard_unix_ms, to: now, how: 'lost', text: 'no heartbeat' });
  }
  return out;
}

/** Every worker there is, and those that only the events remember: a finished training has none left. */
export function names(events: Event[], workers: Worker[]): string[] {
  return [...new Set([...workers.map((w) => w.name), ...events.map((e) => e.worker)])].filter(Boolean);
}

function kindOf(e: Event): NonNullable<Event['kind']> {
  if (e.kind !== undefined) return e.kind;
  if (/\b(began|started|leased|granted)\b/.test(e.what)) return 'began';
  if (/\blost\b|no heartbeat/.test(e.what)) return 'lost';
  if (/\brevoked\b|no longer needed|waits (for a worker again|before its next)/.test(e.what)) return 'revoked';
  if (e.level === 'error' || /\bfailed\b/.test(e.what)) return 'failed';
  return /\b(done|finished)\b/.test(e.what) ? 'done' : '';
}

const ROW = 20;
const LEFT = 84;
const SPANS = [2, 10, 60, 360];

export function Gantt({ bars: all, workers, now }: { bars: Bar[]; workers: string[]; now: number }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  // The shortest span that holds all that is known, until the reader chooses another.
  const chosen = useSignal(0);
  const first = Math.min(now, ...all.map((b) => b.from));
  const minutes = chosen.value || (SPANS.find((m) => now - first <= m * 60000) ?? SPANS.at(-1)!);
  const tip = useSignal<{ x: number; y: number; bar: Bar } | null>(null);
  const height = workers.length * ROW + 26;
  const from = now - minutes * 60000;
  const width = (): number => (canvas.current?.clientWidth ?? 600) - LEFT;
  const at = (t: number): number => LEFT + ((t - from) / (now - from)) * width();

  useEffect(() => {
    const c = canvas.current!;
    const ratio = Math.min(2, devicePixelRatio || 1);
    c.width = Math.round(c.clientWidth * ratio);
    c.height = Math.round(height * ratio);
    const g = c.getContext('2d')!;
    g.scale(ratio, ratio);
    g.font = '11px system-ui, sans-serif';
    g.textBaseline = 'middle';
    const states = stateColours();
    const colour = { running: states[RUNNING]!, done: states[DONE]!, failed: states[FAILED]!, lost: css('bad'), idle: css('wash') };
    for (let k = 0; k <= 5; k += 1) {
      const x = LEFT + (k / 5) * width();
      g.strokeStyle = css('line');
      g.beginPath(); g.moveTo(x + 0.5, 0); g.lineTo(x + 0.5, height - 22); g.stroke();
      g.fillStyle = css('muted');
      g.textAlign = k === 5 ? 'right' : k === 0 ? 'left' : 'center';
      g.fillText(clock(from + (k / 5) * (now - from)), x, height - 10);
    }
    g.textAlign = 'left';
    workers.forEach((name, i) => { g.fillStyle = css('text'); g.fillText(name.length > 12 ? `${name.slice(0, 11)}…` : name, 2, i * ROW + ROW / 2, LEFT - 6); });
    for (const bar of all) {
      const row = workers.indexOf(bar.worker);
      const [x0, x1] = [Math.max(LEFT, at(bar.from)), at(bar.to ?? now)];
      if (row < 0 || x1 < LEFT) continue;
      const y = row * ROW + 3;
      g.fillStyle = colour[bar.how];
      g.fillRect(x0, y, Math.max(1, x1 - x0 - 1), ROW - 6);
      if (bar.how === 'lost' || bar.how === 'failed') { // a bar across says it without colour
        g.strokeStyle = '#fff';
        g.beginPath(); for (let x = x0; x < x1 - 4; x += 7) { g.moveTo(x, y + ROW - 6); g.lineTo(x + 5, y); } g.stroke();
      }
      if (x1 - x0 > 60) { g.fillStyle = bar.how === 'idle' ? css('muted') : '#fff'; if (bar.how === 'idle') g.fillText(fitted(g, bar.text, x1 - x0 - 8), x0 + 4, y + (ROW - 6) / 2); }
    }
  });

  const find = (e: MouseEvent): void => {
    const name = workers[Math.floor(e.offsetY / ROW)];
    const bar = all.find((b) => b.worker === name && at(b.from) <= e.offsetX && at(b.to ?? now) >= e.offsetX);
    tip.value = bar ? { x: e.offsetX, y: e.offsetY, bar } : null;
  };
  void dark.value;
  return (
    <>
      <div class="tools"><label>Last <select value={String(minutes)} onChange={(e) => { chosen.value = Number(e.currentTarget.value); }}>
        {SPANS.map((m) => <option key={m} value={String(m)}>{m < 60 ? `${m} min` : `${m / 60} h`}</option>)}</select></label></div>
      <div class="scroll" style={{ position: 'relative', maxHeight: '420px', padding: '0 12px 8px' }} tabIndex={0} aria-label="Workers over time">
        <canvas ref={canvas} style={{ width: '100%', height: `${height}px`, display: 'block' }} role="img" aria-label={`What ${workers.length} workers did in the last ${minutes} minutes; the events page lists the same`} onMouseMove={find} onMouseLeave={() => { tip.value = null; }} />
        {tip.value && <div class="tip" style={{ left: `${Math.min(tip.value.x + 14, width() - 160)}px`, top: `${tip.value.y + 14}px` }}><b>{tip.value.bar.worker}</b> {tip.value.bar.how}<br />{tip.value.bar.text}<br />{span(((tip.value.bar.to ?? now) - tip.value.bar.from) / 1000)} from {clock(tip.value.bar.from)}</div>}
      </div>
      <div class="legend">
        {([['running', RUNNING], ['done', DONE], ['failed', FAILED]] as const).map(([name, s]) => <span key={name}><i class={`key ${s === FAILED ? 'hatch' : ''}`} style={{ backgroundColor: stateColours()[s] }} />{name}</span>)}
        <span><i class="key hatch" style={{ backgroundColor: 'var(--bad)' }} />lost</span><span><i class="key" style={{ backgroundColor: 'var(--wash)', border: '1px solid var(--line)' }} />idle, with its reason</span>
      </div>
    </>
  );
}

function fitted(g: CanvasRenderingContext2D, text: string, width: number): string {
  let t = text;
  while (t.length > 1 && g.measureText(t).width > width) t = `${t.slice(0, -2)}…`;
  return t;
}
