// The workers: how they are, and what each did.
import { useComputed } from '@preact/signals';
import type { Worker } from '../api';
import { bytes, fixed, span } from '../format';
import { events, jobs, link, server, serverNow, workers } from '../live';
import { median } from '../problems';
import { href } from '../route';
import { table } from '../tasks';
import { Command, Empty, Panel } from '../widgets/boundary';
import { bars, Gantt, names } from '../widgets/gantt';
import { Grid, type Column } from '../widgets/grid';

const STATE: Record<Worker['state'], [glyph: string, tone: string]> = { busy: ['▶', 'good'], idle: ['○', ''], lost: ['✕', 'bad'], left: ['·', 'muted'] };

export function Cluster() {
  const all = workers.value;
  const middle = useComputed(() => median(workers.value.flatMap((w) => (w.steps_per_second ? [w.steps_per_second] : []))));
  const s = server.value;
  if (all.length === 0) {
    return <div class="panel"><Empty><h3>No worker is known</h3>
      {s?.kind === 'coordinator' ? <>Start one on each machine that should train:<Command>{`plat worker --coordinator ${s.coordinator?.url ?? 'URL'}`}</Command></>
        : s?.kind === 'folder' ? <>This server shows a folder. Train, and watch the workers here:<Command>plat train CAPTURE --out DIR --serve</Command></>
          : <>The training has not started its workers yet.</>}
    </Empty></div>;
  }
  return (
    <>
      <Totals all={all} middle={middle.value} />
      <div class="cols">
        <Panel title="Workers" aside={s?.kind === 'coordinator' && <span>Add one: <code>plat worker --coordinator {s.coordinator?.url ?? 'URL'}</code></span>}><Table all={all} middle={middle.value} /></Panel>
        <Panel title="What they did"><Times all={all} /></Panel>
      </div>
    </>
  );
}

function Totals({ all, middle }: { all: Worker[]; middle: number }) {
  const n = (state: Worker['state']): number => all.filter((w) => w.state === state).length;
  const done = all.reduce((sum, w) => sum + w.done, 0);
  const failed = all.reduce((sum, w) => sum + w.failed, 0);
  const speed = all.reduce((sum, w) => sum + (w.steps_per_second ?? 0), 0);
  const c = server.value?.coordinator;
  const ready = jobs.value.reduce((sum, j) => sum + (j.state === 'running' ? j.counts.ready : 0), 0);
  const cells: [string, string, string][] = [
    ['Busy', String(n('busy')), `${n('idle')} idle`], ['Lost', String(n('lost')), `${n('left')} left in order`],
    ['Speed of all', `${fixed(speed, 1)} /s`, `median ${fixed(middle, 1)} steps/s`], ['Attempts done', String(done), `${failed} failed`], ['Ready tasks', String(ready), 'waiting for a worker'],
    ['Coordinator', c ? (c.reachable ? 'reachable' : 'silent') : 'none', c ? c.url : server.value?.kind === 'train' ? 'one machine' : ''],
  ];
  return <dl class="kpis">{cells.map(([title, value, note]) => <div key={title} class="kpi"><dt>{title}</dt><dd class={`num${value.length > 9 ? ' long' : ''}`}>{value}</dd><dd style={{ font: 'inherit' }}><small>{note}</small></dd></div>)}</dl>;
}

function Table({ all, middle }: { all: Worker[]; middle: number }) {
  const now = serverNow.value;
  const age = (w: Worker): number => Math.max(0, now - w.heard_unix_ms) / 1000;
  const fresh = link.value === 'live';
  const columns: Column[] = [
    { key: 'name', title: 'Worker', width: '130px', by: (i) => all[i]!.name, cell: (i) => <b>{all[i]!.name}</b> },
    { key: 'state', title: 'State', width: '84px', by: (i) => ['lost', 'busy', 'idle', 'left'].indexOf(all[i]!.state), cell: (i) => { const [glyph, tone] = STATE[all[i]!.state]; return <span class={tone}><span aria-hidden="true">{glyph}</span> {all[i]!.state}</span>; } },
    { key: 'backend', title: 'Backend', width: '100px', by: (i) => all[i]!.backend, cell: (i) => all[i]!.backend },
    { key: 'task', title: 'Task', width: '100px', by: (i) => all[i]!.task, cell: (i) => task(all[i]!) },
    { key: 'speed', title: 'Steps/s', width: '76px', number: true, by: (i) => all[i]!.steps_per_second, cell: (i) => <span class="num">{fixed(all[i]!.steps_per_second, 1)}</span> },
    { key: 'ratio', title: 'of median', width: '80px', number: true, by: (i) => all[i]!.steps_per_second, cell: (i) => ratio(all[i]!.steps_per_second, middle) },
    { key: 'heard', title: 'Heartbeat', width: '96px', number: true, by: (i) => all[i]!.heard_unix_ms, cell: (i) => <span class={`num ${fresh && all[i]!.state !== 'left' && age(all[i]!) > 10 ? 'bad' : ''}`}>{span(age(all[i]!))} ago</span> },
    { key: 'memory', title: 'Memory', width: '82px', number: true, by: (i) => all[i]!.memory_bytes, cell: (i) => (all[i]!.memory_bytes === 0 ? 'no limit' : bytes(all[i]!.memory_bytes)) },
    { key: 'done', title: 'Done', width: '56px', number: true, by: (i) => all[i]!.done, cell: (i) => <span class="num">{all[i]!.done}</span> },
    { key: 'failed', title: 'Failed', width: '56px', number: true, by: (i) => all[i]!.failed, cell: (i) => <span class={`num ${all[i]!.failed ? 'bad' : ''}`}>{all[i]!.failed}</span> },
    { key: 'why', title: 'For / why idle', width: 'minmax(230px, 1fr)', by: (i) => all[i]!.idle_reason, cell: (i) => <><span class="num">{span((now - all[i]!.since_unix_ms) / 1000)}</span> <span class="muted">{all[i]!.state === 'idle' ? all[i]!.idle_reason : ''}</span></> },
  ];
  return <Grid label="Workers" rows={all.map((_, i) => i)} columns={columns} sort="state" version={all} height={Math.min(420, all.length * 28 + 2)} />;
}

function task(w: Worker) {
  if (w.task === null) return '–';
  const t = table.value;
  const name = t && t.job === w.job && w.task < t.length ? t.name(w.task) : `task ${w.task}`;
  return <a href={href(`block/${w.task}`, { job: w.job })}>{name}{w.attempt > 1 ? ` (${w.attempt})` : ''}</a>;
}

function ratio(speed: number | null, middle: number) {
  if (speed === null || !(middle > 0)) return '–';
  const share = speed / middle;
  return <span class={`num ${share < 0.5 ? 'warn' : ''}`}>{share < 0.5 ? '▼ ' : ''}{fixed(100 * share, 0)} %</span>;
}

function Times({ all }: { all: Worker[] }) {
  // Once all have left, time ends with the last event: a training of yesterday is looked at like one of now.
  const over = all.every((w) => w.state === 'left') ? events.value.findLast((e) => e.worker)?.unix_ms : undefined;
  const now = over ?? serverNow.value;
  return <Gantt bars={bars(events.value, all, now)} workers={names(events.value, all)} now={now} />;
}
