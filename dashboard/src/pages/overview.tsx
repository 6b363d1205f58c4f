// The job at a glance: its numbers, the map, what needs attention, what happened.
import { useSignal } from '@preact/signals';
import { control, type Control, type Curve } from '../api';
import { count, DASH, fixed, left, span } from '../format';
import { job, server, serverNow, workers } from '../live';
import { go, href } from '../route';
import { table, tableError, version } from '../tasks';
import { Command, Empty, Panel, useGet, Waiting } from '../widgets/boundary';
import { Attention, Feed } from '../widgets/feed';
import { Legend } from '../widgets/legend';
import { CityMap } from '../widgets/map';
import type { Look } from '../widgets/mapdraw';
import { QualityCurve } from '../widgets/spark';

const LOOK: Look = { by: 'state', level: -1, cameras: false, points: true };

export function Overview() {
  const selection = useSignal(new Set<number>());
  const t = table.value;
  return (
    <>
      <Numbers />
      <div class="cols">
        <Panel title="City" class="w7" aside={<a href={href('blocks')}>All blocks</a>}>
          {t ? <CityMap small table={t} version={version.value} look={LOOK} selection={selection} onOpen={(task) => go(href(`block/${task}`))} /> : <Waiting error={tableError.value} what="the plan" />}
          {t && <Legend table={t} look={LOOK} />}
        </Panel>
        <div class="w5" style={{ display: 'grid', gap: '12px' }}>
          <Panel title="Needs attention"><Attention /></Panel>
          <Quality />
          <Panel title="Activity" aside={<a href={href('events')}>All events</a>}><Feed count={14} /></Panel>
        </div>
      </div>
    </>
  );
}

function Quality() {
  const j = job.value!;
  const asked = useGet<Curve>(`/api/jobs/${j.id}/curve`, `${j.counts.done} ${j.state}`);
  if (!asked.value || asked.value.psnr.length === 0) return null;
  return <Panel title="Held-out PSNR while it trains" aside={<a href={href('compare')}>Speed and accuracy</a>}><QualityCurve curve={asked.value} /></Panel>;
}

function Numbers() {
  const j = job.value!;
  const live = workers.value.filter((w) => w.state === 'busy' || w.state === 'idle').length;
  const elapsed = j.started_unix_ms === null ? null : ((j.ended_unix_ms ?? serverNow.value) - j.started_unix_ms) / 1000;
  const t = table.value;
  void version.value;
  let blocksDone: number | null = null;
  if (t) { blocksDone = 0; for (let i = 0; i < t.blocks; i += 1) if (t.state[i] === 3) blocksDone += 1; }
  const broken = j.counts.failed + j.counts.quarantined;
  return (
    <>
      <dl class="kpis">
        <Kpi title="Blocks done" value={`${blocksDone ?? j.counts.done} / ${j.blocks}`} share={(blocksDone ?? j.counts.done) / Math.max(1, j.blocks)}
          note={`${j.counts.leased} running · ${j.counts.ready} ready${broken ? ` · ${broken} failed` : ''}`} />
        <Kpi title="Splats" value={count(j.splats)} note={t ? `${t.levels} ${t.levels === 1 ? 'level' : 'levels'}` : ''} />
        <Kpi title="Held-out PSNR" value={j.psnr === null ? DASH : `${fixed(j.psnr, 2)} dB`} note={j.psnr === null ? 'not measured yet' : 'mean of the views'} />
        <Kpi title="SSIM" value={fixed(j.ssim, 3)} note="held-out" />
        <Kpi title="SSIMULACRA2" value={fixed(j.perceptual, 1)} note="held-out" />
        {j.cpu_seconds < 3600 ? <Kpi title="CPU time" value={span(j.cpu_seconds)} note="of all attempts" />
          : <Kpi title="CPU hours" value={fixed(j.cpu_seconds / 3600, j.cpu_seconds < 36000 ? 2 : 1)} note="of all attempts" />}
        <Kpi title="Elapsed" value={span(elapsed)} note={live ? `${live} workers` : 'no worker'} />
        <Kpi title="Time left" long value={j.state !== 'running' ? j.state : j.eta_seconds ? left(...j.eta_seconds) : DASH} note={j.eta_note} />
      </dl>
      {j.state === 'running' && live === 0 && server.value?.kind === 'coordinator' && (
        <div class="panel" style={{ marginBottom: '12px' }}><Empty><h3>No worker is connected</h3>The tasks wait. Start a worker on each machine:
          <Command>{`plat worker --coordinator ${server.value.coordinator?.url ?? 'URL'}`}</Command></Empty></div>
      )}
      {server.value?.controls && (j.state === 'running' || j.state === 'paused') && <Controls />}
    </>
  );
}

function Kpi({ title, value, note, share, long }: { title: string; value: string; note: string; share?: number; long?: boolean }) {
  return (
    <div class={long ? 'kpi wide' : 'kpi'}><dt>{title}</dt><dd class={`num${long ? ' long' : ''}`}>{value}</dd>
      <dd style={{ font: 'inherit' }}>{share !== undefined && <div class="meter"><i style={{ width: `${100 * share}%` }} /></div>}<small>{note}</small></dd></div>
  );
}

function Controls() {
  const j = job.value!;
  const said = useSignal('');
  const sure = useSignal(false);
  const send = async (body: Control): Promise<void> => {
    sure.value = false;
    try { await control(j.id, body); said.value = ''; } catch (e) { said.value = (e as Error).message; }
  };
  return (
    <div class="tools" style={{ padding: '0 0 12px' }} role="group" aria-label="Job">
      {j.state === 'paused' ? <button type="button" class="main" onClick={() => void send({ what: 'resume' })}>Resume job</button>
        : <button type="button" onClick={() => void send({ what: 'pause' })}>Pause job</button>}
      {!sure.value ? <button type="button" onClick={() => { sure.value = true; }}>Cancel job …</button>
        : <span>Cancel {j.name}? {j.counts.leased} running attempts end; what is done stays. <button type="button" onClick={() => void send({ what: 'cancel' })}>Cancel it</button> <button type="button" onClick={() => { sure.value = false; }}>Keep it</button></span>}
      <label>Priority <input type="number" style={{ width: '70px' }} value={j.priority} onChange={(e) => void send({ what: 'priority', priority: Number(e.currentTarget.value) })} /></label>
      <span role="status" class="bad">{said.value}</span>
    </div>
  );
}
