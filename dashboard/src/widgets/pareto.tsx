// The plot of speed against accuracy: own SVG, because the front's steps, labels and keyboard matter more than a chart library.
import type { Ref } from 'preact';
import { useSignal } from '@preact/signals';
import { count, fixed, span } from '../format';
import { dominator, type Run, type XAxis, type YAxis } from './front';

interface Props {
  all: Run[];
  line: Run[];
  split: string;
  x: XAxis;
  y: YAxis;
  pinned: number[];
  onPin: (id: number) => void;
  svg: Ref<SVGSVGElement>;
}

const W = 1060;
const H = 470;
const [LEFT, RIGHT, TOP, BOTTOM] = [58, 22, 16, 44];
const Y_TEXT: Record<YAxis, string> = { psnr: 'Held-out PSNR, dB', ssim: 'Held-out SSIM', perceptual: 'Held-out SSIMULACRA2' };
export const DIGITS: Record<YAxis, number> = { psnr: 2, ssim: 4, perceptual: 1 };

export function Pareto({ all, line, split, x, y, pinned, onPin, svg }: Props) {
  const hover = useSignal<number | null>(null);
  // How the quality of a run grew, for the run under the pointer and those that are pinned. The plot makes room for pinned ones.
  const grown = (id: number): [number, number][] => (x === 'cpu_seconds' && y === 'psnr' ? all.find((p) => p.id === id)?.r.curve.map((c): [number, number] => [c.cpu_seconds, c.psnr]).filter(([s]) => s > 0) ?? [] : []);
  const kept = (all.length === 1 ? [all[0]!.id] : pinned).flatMap(grown);
  const xs = [...all.map((p) => p.x), ...kept.map(([s]) => s)];
  const [x0, x1] = [Math.log10(Math.min(...xs)) - 0.08, Math.max(Math.log10(Math.max(...xs)) + 0.15, Math.log10(Math.min(...xs)) + 0.5)];
  const ys = [...all.map((p) => p.y), ...kept.map(([, v]) => v)];
  const pad = Math.max((Math.max(...ys) - Math.min(...ys)) * 0.08, y === 'ssim' ? 0.01 : 0.25);
  const [y0, y1] = [Math.min(...ys) - pad, Math.max(...ys) + pad];
  const px = (v: number): number => LEFT + ((Math.log10(v) - x0) / (x1 - x0)) * (W - LEFT - RIGHT);
  const py = (v: number): number => TOP + (1 - (v - y0) / (y1 - y0)) * (H - TOP - BOTTOM);
  const shown = all.find((p) => p.id === hover.value);
  const beaten = new Map(all.map((p) => [p.id, p.r.split === split && p.r.source === null ? dominator(p, line) : null]));
  const steps = line.map((p, i) => (i === 0 ? `M${px(p.x)} ${py(p.y)}` : `H${px(p.x)}V${py(p.y)}`)).join('') + (line.length ? `H${W - RIGHT}` : '');

  return (
    <div style={{ position: 'relative' }}>
      <svg ref={svg} class="pareto" viewBox={`0 0 ${W} ${H}`} role="group" aria-label={`${Y_TEXT[y]} against ${x === 'cpu_seconds' ? 'CPU' : 'wall'} seconds, ${all.length} runs`} font-family="system-ui, sans-serif">
        <g class="lines" stroke="currentColor" stroke-opacity=".35">
          {logTicks(x0, x1).map((v) => <line key={v} x1={px(v)} x2={px(v)} y1={TOP} y2={H - BOTTOM} />)}
          {ticks(y0, y1).map((v) => <line key={v} x1={LEFT} x2={W - RIGHT} y1={py(v)} y2={py(v)} />)}
        </g>
        {logTicks(x0, x1).map((v) => <text key={v} x={px(v)} y={H - BOTTOM + 16} text-anchor="middle" font-size="11" fill="#666">{v >= 1000 ? `${v / 1000} k` : v}</text>)}
        {ticks(y0, y1).map((v) => <text key={v} x={LEFT - 8} y={py(v) + 4} text-anchor="end" font-size="11" fill="#666">{+v.toFixed(4)}</text>)}
        <text x={(W + LEFT) / 2} y={H - 6} text-anchor="middle" font-size="11" fill="#666">{x === 'cpu_seconds' ? 'CPU seconds (log)' : 'wall seconds (log)'}</text>
        <text x={LEFT} y={TOP - 4} font-size="11" fill="#666">{Y_TEXT[y]}</text>
        <path d={steps} fill="none" style={{ stroke: 'var(--c1)' }} stroke="#0072b2" stroke-width="1.75" />
        <clipPath id="plot"><rect x={LEFT} y={TOP} width={W - LEFT - RIGHT} height={H - TOP - BOTTOM} /></clipPath>
        {[...new Set([...pinned, ...(hover.value === null ? [] : [hover.value]), ...(all.length === 1 ? [all[0]!.id] : [])])].map((id) => (
          <polyline key={id} class="grown" points={grown(id).map(([s, v]) => `${px(s)},${py(v)}`).join(' ')} fill="none" stroke="#57616c" style={{ stroke: 'var(--muted)' }} stroke-width="1" clip-path="url(#plot)" />
        ))}
        {all.map((p) => (
          <Mark key={p.id} run={p} cx={px(p.x)} cy={py(p.y)} onFront={line.includes(p)} comparable={p.r.split === split} beaten={beaten.get(p.id) != null} pinned={pinned.includes(p.id)} y={y}
            right={px(p.x) < W - 190} onHover={(id) => { hover.value = id; }} onPin={onPin} />
        ))}
      </svg>
      {shown && <Tip run={shown} by={beaten.get(shown.id) ?? null} comparable={shown.r.split === split} x={x} y={y} left={(100 * px(shown.x)) / W} top={(100 * py(shown.y)) / H} />}
    </div>
  );
}

interface MarkProps {
  run: Run; cx: number; cy: number; onFront: boolean; comparable: boolean; beaten: boolean; pinned: boolean; right: boolean; y: YAxis;
  onHover: (id: number | null) => void;
  onPin: (id: number) => void;
}

/** Circle: a run. Hollow: another split. Square: a published figure. Triangle: this server's own job. */
function Mark({ run, cx, cy, onFront, comparable, beaten, pinned, right, y, onHover, onPin }: MarkProps) {
  const published = run.r.source !== null;
  const colour = published ? 'var(--muted)' : run.r.own ? 'var(--c2)' : 'var(--c1)';
  const size = Math.max(4, Math.min(10, 2.2 * Math.log10((run.r.splats ?? 1e4) / 1e3 + 1) + 3));
  const look = { fill: comparable && !published ? colour : 'var(--panel)', stroke: colour, opacity: beaten ? 0.55 : 1 };
  const shape = published ? <rect x={cx - 5} y={cy - 5} width="10" height="10" stroke-width="1.75" style={look} />
    : run.r.own ? <path d={`M${cx} ${cy - size}L${cx + size} ${cy + size * 0.8}H${cx - size}Z`} stroke-width="1.75" style={look} />
      : <circle cx={cx} cy={cy} r={size} stroke-width="1.75" style={look} />;
  const name = `${run.r.label}: ${fixed(run.y, DIGITS[y])} after ${span(run.x)}${published ? ', published figure' : comparable ? '' : ', another split'}${pinned ? ', pinned' : ''}`;
  return (
    <g class="mark" tabindex={0} role="button" aria-label={name} aria-pressed={pinned}
      onMouseEnter={() => onHover(run.id)} onMouseLeave={() => onHover(null)} onFocus={() => onHover(run.id)} onBlur={() => onHover(null)}
      onClick={() => onPin(run.id)} onKeyDown={(e) => { if (e.key === 'Enter' || e.key === ' ') { e.preventDefault(); onPin(run.id); } }}>
      <circle cx={cx} cy={cy} r="13" fill="transparent" />
      {pinned && <circle cx={cx} cy={cy} r={size + 4} fill="none" stroke-width="2" style={{ stroke: 'var(--select)' }} />}
      {shape}
      {(onFront || published || pinned || !comparable) && <text x={right ? cx + size + 5 : cx - size - 5} y={cy + (published ? 4 : 14)} text-anchor={right ? 'start' : 'end'} font-size="11" fill="#666">{run.r.label}{!comparable && !published ? ' (other views)' : ''}</text>}
    </g>
  );
}

function Tip({ run: p, by, comparable, x, y, left, top }: { run: Run; by: Run | null; comparable: boolean; x: XAxis; y: YAxis; left: number; top: number }) {
  const unit = y === 'psnr' ? ' dB' : '';
  return (
    <div class="tip" style={{ left: `min(${left}% + 14px, 100% - 330px)`, top: `${Math.min(top, 72)}%` }}>
      <b>{p.r.label}</b> {p.r.scene}<br />
      {fixed(p.y, DIGITS[y])}{unit} · {span(p.x)} {x === 'cpu_seconds' ? 'CPU' : 'wall'} · {count(p.r.splats)} splats<br />
      {p.r.source ? <>published: {p.r.source}; not joined to the front</>
        : !comparable ? <>other held-out views ({p.r.split}): not comparable</>
          : by ? <>dominated by <b>{by.r.label}</b>: +{fixed(by.y - p.y, DIGITS[y])}{unit}, {fixed(100 * (by.x / p.x - 1), 0)} % time</>
            : <>on the front</>}
    </div>
  );
}

function ticks(low: number, high: number): number[] {
  const rough = (high - low) / 6;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((k) => k * power).find((s) => s >= rough) ?? rough;
  const out: number[] = [];
  for (let v = Math.ceil(low / step) * step; v <= high; v += step) out.push(v);
  return out;
}

function logTicks(low: number, high: number): number[] {
  const out: number[] = [];
  for (let e = Math.floor(low); e <= Math.ceil(high); e += 1) for (const k of high - low > 3 ? [1] : [1, 2, 5]) out.push(k * 10 ** e);
  return out.filter((v) => Math.log10(v) >= low && Math.log10(v) <= high).map((v) => +v.toPrecision(3));
}
