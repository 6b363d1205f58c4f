// Speed against accuracy over all measured runs, with the front of those that may be compared.
import { useRef } from 'preact/hooks';
import { useSignal } from '@preact/signals';
import type { Result } from '../api';
import { count, fixed, save, span } from '../format';
import { route, setQuery } from '../route';
import { Command, Empty, Panel, useGet, Waiting } from '../widgets/boundary';
import { csv, dominator, front, mainSplit, ROWS, runs, type XAxis, type YAxis } from '../widgets/front';
import { Grid, type Column } from '../widgets/grid';
import { Pareto } from '../widgets/pareto';

export function Compare() {
  const asked = useGet<{ results: Result[] }>('/api/results', 0, 20000);
  const { query } = route.value;
  const x = (query.get('x') ?? 'cpu_seconds') as XAxis;
  const y = (query.get('y') ?? 'psnr') as YAxis;
  const asTable = query.get('as') === 'table';
  const pinned = useSignal<number[]>([]);
  const svg = useRef<SVGSVGElement>(null);
  if (!asked.value) return <Waiting error={asked.error} what="the results" />;
  const every = asked.value.results;
  if (every.length === 0) return <div class="panel"><Empty><h3>Nothing is measured yet</h3>A finished training with held-out views appears here. Or measure a few settings:<Command>plat bench pareto CAPTURE</Command></Empty></div>;
  const scenes = [...new Set(every.map((r) => r.scene))].sort();
  const most = scenes.map((s) => [s, every.filter((r) => r.scene === s).length] as const).sort((a, b) => b[1] - a[1])[0]![0];
  const scene = query.get('scene') ?? most;
  const of = every.filter((r) => r.scene === scene);
  const splits = [...new Set(of.map((r) => r.split))];
  const split = query.get('split') ?? mainSplit(of);
  const all = runs(of, x, y);
  const line = front(all, split);
  const other = all.filter((p) => p.r.split !== split && p.r.source === null).length;
  const pin = (id: number): void => { pinned.value = pinned.value.includes(id) ? pinned.value.filter((p) => p !== id) : [...pinned.value, id].slice(-2); };
  const exportSvg = (): void => { if (svg.current) save(`${scene}-${y}.svg`, plain(svg.current), 'image/svg+xml'); };

  return (
    <div class="cols">
      <Panel title="Speed and accuracy" aside={
        <>
          <label>Scene <select value={scene} onChange={(e) => { pinned.value = []; setQuery({ scene: e.currentTarget.value, split: null }); }}>{scenes.map((s) => <option key={s}>{s}</option>)}</select></label>
          <label>Time <select value={x} onChange={(e) => setQuery({ x: e.currentTarget.value })}><option value="cpu_seconds">CPU seconds</option><option value="wall_seconds">wall seconds</option></select></label>
          <label>Quality <select value={y} onChange={(e) => setQuery({ y: e.currentTarget.value })}><option value="psnr">PSNR</option><option value="ssim">SSIM</option><option value="perceptual">SSIMULACRA2</option></select></label>
          {splits.length > 1 && <label>Front of <select value={split} onChange={(e) => setQuery({ split: e.currentTarget.value })}>{splits.map((s) => <option key={s}>{s}</option>)}</select></label>}
          <button type="button" aria-pressed={asTable} onClick={() => setQuery({ as: asTable ? null : 'table' })}>Table</button>
          <button type="button" onClick={() => save(`${scene}.csv`, csv(of), 'text/csv')}>CSV</button>
          <button type="button" disabled={asTable} onClick={exportSvg}>SVG</button>
        </>
      }>
        <div class="body">
          {all.length === 0 ? <div class="empty">No run of {scene} has both numbers measured.</div>
            : asTable ? <Table all={of} x={x} y={y} split={split} pinned={pinned.value} onPin={pin} />
              : <Pareto all={all} line={line} split={split} x={x} y={y} pinned={pinned.value} onPin={pin} svg={svg} />}
        </div>
        <div class="legend">
          <span>● run</span><span>▲ own job</span><span>○ other held-out views{other ? `: ${other}, not comparable` : ''}</span><span>□ published figure, not joined</span><span>faded: dominated</span>{x === 'cpu_seconds' && y === 'psnr' && <span>thin line: how a run got there (point or click)</span>}<span>size: splats</span>
        </div>
      </Panel>
      <Panel title="Comparison"><Diff results={of} pinned={pinned.value} /></Panel>
    </div>
  );
}

function Table({ all, x, y, split, pinned, onPin }: { all: Result[]; x: XAxis; y: YAxis; split: string; pinned: number[]; onPin: (id: number) => void }) {
  const points = runs(all, x, y);
  const line = front(points, split);
  const status = (i: number): string => {
    const r = all[i]!;
    const p = points.find((q) => q.id === i);
    if (r.source) return `published: ${r.source}`;
    if (!p) return 'not measured';
    if (r.split !== split) return 'other held-out views';
    const by = dominator(p, line);
    return by ? `dominated by ${by.r.label}` : 'on the front';
  };
  const number = (key: 'cpu_seconds' | 'wall_seconds' | 'psnr' | 'ssim' | 'perceptual' | 'splats' | 'steps', title: string, cell: (v: number | null) => string): Column =>
    ({ key, title, width: '92px', number: true, by: (i) => all[i]![key], cell: (i) => cell(all[i]![key]) });
  const columns: Column[] = [
    { key: 'label', title: 'Run', width: '230px', by: (i) => all[i]!.label, cell: (i) => all[i]!.label },
    number('cpu_seconds', 'CPU', span), number('wall_seconds', 'Wall', span), number('psnr', 'PSNR, dB', (v) => fixed(v, 2)), number('ssim', 'SSIM', (v) => fixed(v, 4)),
    number('perceptual', 'SSIMULACRA2', (v) => fixed(v, 1)), number('splats', 'Splats', count), number('steps', 'Steps', count),
    { key: 'status', title: 'Front', width: 'minmax(220px, 1fr)', by: status, cell: status },
  ];
  return <Grid label="Runs" rows={all.map((_, i) => i)} columns={columns} sort={y} descending version={`${x}${y}${split}${all.length}${pinned}`} height={430} onOpen={onPin} chosen={(i) => pinned.includes(i)} />;
}

function Diff({ results, pinned }: { results: Result[]; pinned: number[] }) {
  const [a, b] = [results[pinned[0] ?? -1], results[pinned[1] ?? -1]];

  if (!a || !b) return <div class="empty">{a ? `${a.label} is pinned. Click a second run to compare them.` : 'Click a run to pin it; two pins are compared here.'}</div>;
  return (
    <div class="scroll"><table class="plain" data-testid="diff">
      <thead><tr><th /><th>{a.label}</th><th>{b.label}</th><th class="n">Difference</th></tr></thead>
      <tbody>
        {ROWS.map(([title, key, digits]) => {
          const [p, q] = [a[key], b[key]];
          if (p === null && q === null) return null;
          const show = (v: unknown): string => (v === null ? '–' : digits !== null ? fixed(v as number, digits) : String(v));
          const gap = typeof p === 'number' && typeof q === 'number' ? `${q > p ? '+' : ''}${fixed(q - p, digits ?? 0)}${key === 'cpu_seconds' || key === 'wall_seconds' ? ` (${fixed(100 * (q / p - 1), 0)} %)` : ''}` : p === q ? '' : 'differs';
          return <tr key={key}><td class="muted">{title}</td><td class="num">{show(p)}</td><td class="num">{show(q)}</td><td class="n num">{gap}</td></tr>;
        })}
      </tbody>
    </table>{a.split !== b.split && <p class="warn body">Their held-out views differ: the quality numbers cannot be compared.</p>}</div>
  );
}

/** The plot with its style-sheet colours written out, so that the file stands alone. */
function plain(svg: SVGSVGElement): string {
  const copy = svg.cloneNode(true) as SVGSVGElement;
  copy.setAttribute('xmlns', 'http://www.w3.org/2000/svg');
  const style = getComputedStyle(document.documentElement);
  const text = new XMLSerializer().serializeToString(copy);
  return text.replace(/var\(--([a-z0-9]+)\)/g, (_, name: string) => style.getPropertyValue(`--${name}`).trim()).replace('<svg ', `<svg color="${style.getPropertyValue('--line').trim()}" `);
}

