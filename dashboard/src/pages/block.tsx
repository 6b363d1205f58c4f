// One block: its attempts and their reasons, its curves against the other blocks, its neighbours, worst views and log.
import { useEffect, useMemo } from 'preact/hooks';
import { useComputed, useSignal } from '@preact/signals';
import { get, type Event, type Task, type View } from '../api';
import { css, GLYPHS } from '../colours';
import { bytes, clock, count, DASH, fixed, metres, save, span, utc } from '../format';
import { events, job, jobId, server, serverNow } from '../live';
import { href, route } from '../route';
import { dark } from '../settings';
import { LETTERS, NAMES, RUNNING, table, version } from '../tasks';
import { Empty, Panel, useGet, Waiting } from '../widgets/boundary';
import { Chart, type Line } from '../widgets/chart';
import { Retry } from '../widgets/feed';
import { WorstViews } from '../widgets/views';

export function Block() {
  const t = table.value;
  const id = Number(route.value.argument);
  const running = useComputed(() => { void version.value; return table.value?.state[id] === RUNNING; });
  const state = useComputed(() => { void version.value; return `${table.value?.state[id]} ${table.value?.attempt[id]}`; });
  const asked = useGet<Task>(`/api/jobs/${jobId.value}/tasks/${id}`, state.value, running.value ? 2000 : 15000);
  const views = useGet<{ views: View[] }>(`/api/jobs/${jobId.value}/views`, jobId.value);
  const task = asked.value;
  if (!Number.isInteger(id)) return <Empty>The address names no block. <a href={href('blocks')}>All blocks</a></Empty>;
  if (!task) return <Waiting error={asked.error} what={`task ${id}`} />;
  const name = task.block ?? t?.name(id) ?? `task ${id}`;
  const mine = views.value?.views.filter((v) => inBlock(v, task)) ?? [];
  return (
    <>
      <Head task={task} name={name} />
      <div class="cols">
        <Panel title="Loss" class="w6"><div class="body"><Curves task={task} what="loss" /></div></Panel>
        <Panel title="Splats" class="w6"><div class="body"><Curves task={task} what="splats" /></div></Panel>
        <Panel title="Attempts" class="w6"><Attempts task={task} /></Panel>
        <Panel title="Neighbours" class="w6"><Neighbours task={task} /></Panel>
        <Panel title="Worst held-out views" class="w6">
          {views.error ? <div class="failure">{views.error}</div> : <WorstViews job={jobId.value!} views={mine} />}
        </Panel>
        <Panel title="Log" class="w6"><Log task={id} name={name} /></Panel>
      </div>
    </>
  );
}

/** Views are the block's if the server says so; otherwise those whose camera stands in it or in its halo. */
function inBlock(v: View, task: Task): boolean {
  if (v.task != null) return v.task === task.task;
  const root = table.value?.plan.root;
  if (!root || !task.block) return false;
  const [l, x, y] = task.block.split('/').map(Number) as [number, number, number];
  const e = root.edge / 2 ** l;
  const halo = 0.2 * e;
  const m = v.camera.world_from_camera;
  const [px, py] = [m[3]! - root.x - x * e, m[7]! - root.y - y * e];
  return px >= -halo && py >= -halo && px <= e + halo && py <= e + halo;
}

function Head({ task, name }: { task: Task; name: string }) {
  void version.value;
  const t = table.value;
  const s = t?.state[task.task] ?? LETTERS.indexOf(task.state as 'w');
  const last = task.attempts.at(-1);
  return (
    <div class="panel" style={{ marginBottom: '12px' }}>
      <div class="tools">
        <h2 style={{ fontSize: '16px' }}>{task.kind === 'train' ? 'Block' : ''} {name}</h2>
        <span><span aria-hidden="true">{GLYPHS[s]}</span> {NAMES[s]}{s === RUNNING && t ? <span class="num"> {Math.floor(t.progress[task.task]! / 10)} %</span> : ''}</span>
        {last && last.end !== 'running' && last.end !== 'done' && last.reason && <span class="bad">{last.reason}</span>}
        {server.value?.controls && s >= 4 && <Retry main tasks={[task.task]} />}
        <a href={href('blocks', { select: task.task })}>On the map</a>
        {task.block && job.value?.model && <a href={href('view', { block: task.block })}>In the viewer</a>}
      </div>
      <dl class="kpis" style={{ border: 0, borderTop: '1px solid var(--line)', borderRadius: 0, margin: 0 }}>
        {([
          ['Held-out PSNR', task.psnr === null ? DASH : `${fixed(task.psnr, 2)} dB`],
          ['Splats', `${count(t?.splats[task.task] ?? null)} of ${count(task.budget)}`],
          ['Steps', `${Math.round(((t?.progress[task.task] ?? 0) * task.steps) / 1000)} of ${task.steps}`],
          ['Speed', t && t.speed[task.task]! > 0 ? `${fixed(t.speed[task.task], 1)} /s` : DASH],
          ['Resolution', task.rho_metres ? `${metres(task.rho_metres)} a pixel` : DASH],
          ['Memory', bytes(task.memory_bytes)],
          ['Worker', t?.worker[task.task] || DASH],
        ] as const).map(([title, value]) => <div key={title} class="kpi"><dt>{title}</dt><dd class="num long">{value}</dd></div>)}
      </dl>
    </div>
  );
}

function Curves({ task, what }: { task: Task; what: 'loss' | 'splats' }) {
  const { curve, fleet } = task;
  const theme = dark.value;
  const made = useMemo(() => {
    // One x axis for both: the block's own points, and the fleet's shares of the steps.
    const rows = new Map<number, (number | null)[]>();
    const attempts = [...new Set(curve.attempt)].slice(-4);
    const width = 3 + attempts.length;
        const at = (step: number): (number | null)[] => {
      let row = rows.get(step);
      if (!row) rows.set(step, row = Array<number | null>(width).fill(null));
      return row;
    };
    fleet.share.forEach((share, i) => fleet[what][i]?.forEach((v, k) => { at(share * task.steps)[k] = v; }));
    curve.step.forEach((step, i) => {
      const k = attempts.indexOf(curve.attempt[i]!);
      if (k >= 0) at(step)[3 + k] = what === 'loss' ? curve.loss[i] ?? null : curve.splats[i]!;
    });
    const x = [...rows.keys()].sort((a, b) => a - b);
    const column = (k: number): (number | null)[] => x.map((step) => { const v = rows.get(step)![k]!; return v !== null && what === 'loss' && v <= 0 ? null : v; });
    const muted = css('muted');
    const lines: Line[] = [
      { label: 'p10', values: column(0), colour: muted, dash: [2, 3] }, { label: 'median', values: column(1), colour: muted, dash: [5, 3] }, { label: 'p90', values: column(2), colour: muted, dash: [2, 3] },
      // Each step's loss is of one view, so it jumps: the line to read is the smoothed one, the jumps stay pale under it.
      ...attempts.flatMap((a, k): Line[] => {
        const colour = css(`c${1 + (k % 4)}`);
        const line = { label: `attempt ${a}`, values: column(3 + k), colour };
        return what === 'loss' ? [{ ...line, label: `${line.label}, each`, colour: `${colour}59`, thin: true }, { ...line, values: smoothed(line.values) }] : [line];
      }),
    ];
    return { x, lines };
  }, [curve, fleet, what, theme]);
  if (made.x.length === 0) return <div class="empty">{task.attempts.length ? 'The first report has not come yet.' : 'No attempt has begun.'}</div>;
  return <Chart title={what === 'loss' ? 'By step, log scale; band: p10 to p90 of its level' : 'By step; band: p10 to p90 of its level'} x={made.x} xLabel="step" lines={made.lines} band={[2, 0]} log={what === 'loss'}
    format={what === 'loss' ? (v) => String(+v.toPrecision(3)) : count} />;
}

/** A running mean of the logarithm, over about a twentieth of the points, without a lag at the beginning. */
export function smoothed(values: (number | null)[]): (number | null)[] {
  const keep = 1 - 1 / Math.max(2, values.filter((v) => v !== null).length / 20);
  let sum = 0;
  let weight = 0;
  return values.map((v) => {
    if (v === null) return null;
    sum = keep * sum + Math.log(v);
    weight = keep * weight + 1;
    return Math.exp(sum / weight);
  });
}

const ENDS: Record<string, string> = { running: '', done: 'good', failed: 'bad', lost: 'bad', revoked: 'warn' };

function Attempts({ task }: { task: Task }) {
  if (task.attempts.length === 0) return <div class="empty">{task.parent === null || !table.value ? 'No attempt has begun.' : `No attempt has begun: it waits for ${table.value.name(task.parent)} or for a worker.`}</div>;
  return (
    <div class="scroll"><table class="plain">
      <thead><tr><th class="n">#</th><th>Worker</th><th>Began</th><th class="n">Took</th><th>End</th><th>Reason</th></tr></thead>
      <tbody>
        {[...task.attempts].reverse().map((a) => (
          <tr key={a.number}><td class="n">{a.number}</td><td>{a.worker}</td><td title={utc(a.began_unix_ms)}>{clock(a.began_unix_ms)}</td>
            <td class="n num">{span(((a.ended_unix_ms ?? serverNow.value) - a.began_unix_ms) / 1000)}</td><td class={ENDS[a.end]}>{a.end}</td><td>{a.reason || DASH}</td></tr>
        ))}
      </tbody>
    </table></div>
  );
}

function Neighbours({ task }: { task: Task }) {
  void version.value;
  const t = table.value;
  if (task.kind !== 'train') return <div class="empty">Only blocks have neighbours.</div>;
  return (
    <div class="scroll"><table class="plain">
      <thead><tr><th>Block</th><th>Relation</th><th>State</th></tr></thead>
      <tbody>
        {task.parent !== null && <tr><td><a href={href(`block/${task.parent}`)}>{t?.name(task.parent) ?? task.parent}</a></td><td>parent</td><td>{t ? NAMES[t.state[task.parent]!] : DASH}</td></tr>}
        {task.neighbours.map((n) => <tr key={n}><td><a href={href(`block/${n}`)}>{t?.name(n) ?? n}</a></td><td>neighbour</td><td>{t ? NAMES[t.state[n]!] : DASH}</td></tr>)}
        {task.parent === null && task.neighbours.length === 0 && <tr><td colSpan={3} class="muted">None: this block covers the scene.</td></tr>}
      </tbody>
    </table></div>
  );
}

function Log({ task, name }: { task: number; name: string }) {
  const lines = useSignal<Event[]>([]);
  const filter = useSignal('');
  const failed = useSignal('');
  const id = jobId.value;
  useEffect(() => {
    lines.value = [];
    get<{ lines: Event[] }>(`/api/jobs/${id}/log?after=0&task=${task}`).then((r) => { lines.value = r.lines; failed.value = ''; }).catch((e: Error) => { failed.value = e.message; });
  }, [id, task]);
  // What came since is in the live events already.
  const all = useComputed(() => {
    const last = lines.value.at(-1)?.number ?? 0;
    const wanted = filter.value.toLowerCase();
    return [...lines.value, ...events.value.filter((e) => e.number > last && e.job === id && e.task === task)].filter((e) => !wanted || `${e.level} ${e.what} ${e.worker}`.toLowerCase().includes(wanted));
  });
  const text = (e: Event): string => `${new Date(e.unix_ms).toISOString()} ${e.level.padEnd(5)} ${e.worker} #${e.attempt} ${e.what}`;
  return (
    <>
      <div class="tools"><label>Filter <input type="search" value={filter.value} onInput={(e) => { filter.value = e.currentTarget.value; }} /></label>
        <button type="button" onClick={() => save(`log-${name.replaceAll('/', '-')}.txt`, all.value.map(text).join('\n'), 'text/plain')}>Download</button>
        <span class="bad">{failed.value}</span></div>
      <div class="log" tabIndex={0} role="log" aria-label={`Log of ${name}`}>
        {all.value.length === 0 && <div class="muted">No line{filter.value ? ' matches' : ' yet'}.</div>}
        {all.value.slice(-400).map((e) => <div key={e.number} class={e.level === 'error' ? 'bad' : e.level === 'warn' ? 'warn' : ''}><span class="muted">{clock(e.unix_ms)}</span> {e.worker} #{e.attempt} {e.what}</div>)}
      </div>
    </>
  );
}
