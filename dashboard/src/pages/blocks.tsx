// The map of all blocks, its table twin, and what can be done to the selected ones.
import { useEffect } from 'preact/hooks';
import { useComputed, useSignal, type Signal } from '@preact/signals';
import { GLYPHS } from '../colours';
import { count, fixed } from '../format';
import { server } from '../live';
import { go, href, route, setQuery } from '../route';
import { FAILED, NAMES, QUARANTINED, RUNNING, table, tableError, version, type TaskTable } from '../tasks';
import { Panel, Waiting } from '../widgets/boundary';
import { Retry } from '../widgets/feed';
import { Grid, type Column } from '../widgets/grid';
import { Legend } from '../widgets/legend';
import { CityMap } from '../widgets/map';
import type { ColourBy, Look } from '../widgets/mapdraw';

const BY: [ColourBy, string][] = [['state', 'state'], ['psnr', 'held-out PSNR'], ['splats', 'splats'], ['speed', 'speed'], ['worker', 'worker']];

export function Blocks() {
  const t = table.value;
  const { query } = route.value;
  const chosen = query.get('select');
  const selection = useSignal(new Set<number>());
  useEffect(() => { selection.value = new Set((chosen ?? '').split('.').filter(Boolean).map(Number)); }, [chosen]);
  const layers = useSignal({ cameras: true, points: true });
  const look: Look = { by: (query.get('by') as ColourBy | null) ?? 'state', level: Number(query.get('level') ?? -1), ...layers.value };
  if (!t) return <Waiting error={tableError.value} what="the plan" />;
  const open = (task: number): void => go(href(`block/${task}`));
  return (
    <div class="cols">
      <Panel title="Blocks" class="w8" aside={
        <>
          <label>Colour by
            <select value={look.by} onChange={(e) => setQuery({ by: e.currentTarget.value === 'state' ? null : e.currentTarget.value })}>
              {BY.map(([by, text]) => <option key={by} value={by}>{text}</option>)}
            </select>
          </label>
          <label>Level
            <select value={String(look.level)} onChange={(e) => setQuery({ level: e.currentTarget.value === '-1' ? null : e.currentTarget.value })}>
              <option value="-1">finest</option>
              {Array.from({ length: t.levels }, (_, l) => <option key={l} value={String(l)}>{l}</option>)}
            </select>
          </label>
          <label><input type="checkbox" checked={look.cameras} onChange={(e) => { layers.value = { ...layers.value, cameras: e.currentTarget.checked }; }} />cameras</label>
          <label><input type="checkbox" checked={look.points} onChange={(e) => { layers.value = { ...layers.value, points: e.currentTarget.checked }; }} />points</label>
        </>
      }>
        <CityMap table={t} version={version.value} look={look} selection={selection} onOpen={open} />
        <Legend table={t} look={look} />
      </Panel>
      <div class="w4"><Selected table={t} selection={selection} /></div>
      <Panel title="Table" aside={<span class="num">{t.length} tasks</span>}><Rows table={t} level={look.level} selection={selection} onOpen={open} /></Panel>
    </div>
  );
}

function Selected({ table: t, selection }: { table: TaskTable; selection: Signal<Set<number>> }) {
  void version.value;
  const tasks = [...selection.value].filter((i) => i < t.length);
  const retryable = tasks.filter((i) => t.state[i] === FAILED || t.state[i] === QUARANTINED);
  const sum = tasks.reduce((n, i) => n + t.splats[i]!, 0);
  const measured = tasks.map((i) => t.psnr[i]!).filter((v) => v > 0);
  return (
    <Panel title="Selection" aside={tasks.length > 0 && <button type="button" class="quiet" onClick={() => { selection.value = new Set(); }}>Clear</button>}>
      {tasks.length === 0
        ? <div class="empty">Click a block, or drag with shift held to select many. Double-click opens a block. With the keyboard: arrows, space, Enter.</div>
        : (
          <div class="body">
            <dl class="facts">
              <dt>Blocks</dt><dd class="num">{tasks.length}</dd>
              <dt>Splats</dt><dd class="num">{count(sum)}</dd>
              <dt>Held-out PSNR</dt><dd class="num">{measured.length ? `${fixed(measured.reduce((a, b) => a + b, 0) / measured.length, 2)} dB over ${measured.length}` : 'not measured'}</dd>
            </dl>
            {server.value?.controls && <div class="tools" style={{ padding: '10px 0' }}><Retry main tasks={retryable} />
              <span class="muted">{retryable.length ? `${retryable.length} failed or quarantined` : 'none of them failed'}</span></div>}
            <ul class="rows" style={{ margin: '0 -12px' }}>
              {tasks.slice(0, 14).map((i) => (
                <li key={i}><a href={href(`block/${i}`)}>{t.name(i)}</a> <span aria-hidden="true">{GLYPHS[t.state[i]!]}</span> {NAMES[t.state[i]!]}
                  {t.state[i] === RUNNING ? ` ${Math.floor(t.progress[i]! / 10)} %` : ''} <span class="muted">{t.psnr[i]! > 0 ? `${fixed(t.psnr[i], 2)} dB` : ''} {t.worker[i]}</span></li>
              ))}
              {tasks.length > 14 && <li class="muted">and {tasks.length - 14} more</li>}
            </ul>
          </div>
        )}
    </Panel>
  );
}

const STATE_ORDER = [4, 3, 1, 5, 0, 0.5];

function Rows({ table: t, level, selection, onOpen }: { table: TaskTable; level: number; selection: Signal<Set<number>>; onOpen: (task: number) => void }) {
  const only = useSignal(-1);
  const b = t.plan.blocks;
  const rows = useComputed(() => {
    void version.value;
    const keep: number[] = [];
    for (let i = 0; i < t.length; i += 1) if ((level < 0 || b.level[i] === level) && (only.value < 0 || t.state[i] === only.value)) keep.push(i);
    return keep;
  });
  const columns: Column[] = [
    { key: 'name', title: 'Block', width: '112px', by: (i) => i, cell: (i) => t.name(i) },
    { key: 'state', title: 'State', width: '118px', by: (i) => STATE_ORDER[t.state[i]!]!, cell: (i) => <><span aria-hidden="true">{GLYPHS[t.state[i]!]}</span> {NAMES[t.state[i]!]}</> },
    { key: 'progress', title: 'Done', width: '56px', number: true, by: (i) => t.progress[i]!, cell: (i) => <span class="num">{Math.floor(t.progress[i]! / 10)} %</span> },
    { key: 'steps', title: 'Steps', width: '64px', number: true, by: (i) => b.steps[i] ?? null, cell: (i) => b.steps[i] ?? '–' },
    { key: 'loss', title: 'Loss', width: '68px', number: true, by: (i) => t.loss[i]!, cell: (i) => <span class="num">{fixed(t.loss[i], 4)}</span> },
    { key: 'psnr', title: 'PSNR, dB', width: '74px', number: true, by: (i) => t.psnr[i]!, cell: (i) => <span class="num">{fixed(t.psnr[i], 2)}</span> },
    { key: 'splats', title: 'Splats', width: '72px', number: true, by: (i) => t.splats[i]!, cell: (i) => <span class="num">{t.splats[i] ? count(t.splats[i]) : '–'}</span> },
    { key: 'budget', title: 'Budget', width: '72px', number: true, by: (i) => b.budget[i] ?? null, cell: (i) => count(b.budget[i]) },
    { key: 'speed', title: 'Steps/s', width: '72px', number: true, by: (i) => t.speed[i]!, cell: (i) => <span class="num">{fixed(t.speed[i], 1)}</span> },
    { key: 'views', title: 'Views', width: '60px', number: true, by: (i) => b.views[i] ?? null, cell: (i) => b.views[i] ?? '–' },
    { key: 'attempt', title: 'Attempt', width: '68px', number: true, by: (i) => t.attempt[i]!, cell: (i) => t.attempt[i] || '–' },
    { key: 'worker', title: 'Worker', width: 'minmax(90px, 1fr)', by: (i) => t.worker[i] || null, cell: (i) => t.worker[i] || '–' },
  ];
  return (
    <>
      <div class="tools"><label>State
        <select value={String(only.value)} onChange={(e) => { only.value = Number(e.currentTarget.value); }}>
          <option value="-1">all</option>{NAMES.map((name, s) => <option key={name} value={String(s)}>{name}</option>)}
        </select></label><span class="muted num">{rows.value.length} rows</span></div>
      {/* version is divided so that a table of 10,000 rows is sorted anew every other second, not at each delta */}
      <Grid label="Blocks" rows={rows.value} columns={columns} sort="state" version={t.length > 2000 ? Math.floor(version.value / 4) : version.value} height={420} onOpen={onOpen} chosen={(i) => selection.value.has(i)} />
    </>
  );
}
