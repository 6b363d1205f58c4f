// Lists of what happened and of what needs attention.
import { useComputed, useSignal } from '@preact/signals';
import { control, type Event } from '../api';
import { brief, clock, utc, span } from '../format';
import { events, job, jobs, server, serverNow, workers } from '../live';
import { KIND_TEXT, problems, type Problem } from '../problems';
import { href } from '../route';
import { table, version } from '../tasks';

const MARK: Record<Event['level'], [string, string]> = { info: ['·', 'muted'], warn: ['▲', 'warn'], error: ['✕', 'bad'] };

export function EventRow({ event: e, withJob }: { event: Event; withJob?: boolean }) {
  const [mark, tone] = MARK[e.level];
  const t = table.value;
  const name = e.task === null ? '' : t && t.job === e.job && e.task < t.length ? t.name(e.task) : `task ${e.task}`;
  const of = withJob && e.job !== null ? jobs.value.find((j) => j.id === e.job)?.name ?? `job ${e.job}` : '';
  return (
    <li>
      <time dateTime={new Date(e.unix_ms).toISOString()} title={utc(e.unix_ms)}>{clock(e.unix_ms)}</time>
      <span class={tone} aria-label={e.level} role="img">{mark}</span>
      <span title={brief(e.what) === e.what ? undefined : e.what}>
        {of && <span class="who">{of} </span>}
        {name && <a href={href(`block/${e.task}`, e.job === null ? {} : { job: e.job })}>{name}</a>} {brief(e.what)} {e.worker && <span class="who">{e.worker}</span>}
      </span>
    </li>
  );
}

export function Feed({ count }: { count: number }) {
  const mine = useComputed(() => events.value.filter((e) => e.job === null || e.job === job.value?.id).slice(-count).reverse());
  if (mine.value.length === 0) return <div class="empty">Nothing has happened yet.</div>;
  return <ul class="rows feed">{mine.value.map((e) => <EventRow key={e.number} event={e} />)}</ul>;
}

export function Attention() {
  const all = useComputed(() => {
    void version.value;
    return problems(job.value, table.value, workers.value, events.value);
  });
  if (all.value.length === 0) return <div class="empty"><span class="good">✓</span> Nothing needs attention.</div>;
  return <ul class="rows" data-testid="attention">{all.value.slice(0, 12).map((p) => <Row key={`${p.kind} ${p.what}`} problem={p} />)}</ul>;
}

const TONE: Record<Problem['kind'], string> = { blocked: 'bad', failed: 'bad', lost: 'bad', straggler: 'warn', outlier: 'warn' };

function Row({ problem: p }: { problem: Problem }) {
  const to = p.kind === 'lost' ? href('cluster') : p.tasks.length === 1 ? href(`block/${p.tasks[0]}`)
    : p.tasks.length > 1 ? href('blocks', { select: p.tasks.slice(0, 200).join('.'), by: p.kind === 'outlier' ? 'psnr' : null }) : null;
  return (
    <li class="problem">
      <span class={`kind ${TONE[p.kind]}`}>{KIND_TEXT[p.kind]}</span>
      <span>{to ? <a href={to}>{p.what}</a> : p.what}{p.since ? <span class="muted num"> · {span((serverNow.value - p.since) / 1000)} ago</span> : ''}</span>
      {p.kind === 'failed' && server.value?.controls && <span class="acts"><Retry tasks={p.tasks} /></span>}
      <p>{p.note}</p>
    </li>
  );
}

/** Retries tasks, and says what became of the request. */
export function Retry({ tasks, main }: { tasks: number[]; main?: boolean }) {
  const said = useSignal('');
  const busy = useSignal(false);
  const send = async (): Promise<void> => {
    busy.value = true;
    try {
      await control(job.value!.id, { what: 'retry', tasks });
      said.value = 'asked';
    } catch (e) {
      said.value = (e as Error).message;
    }
    busy.value = false;
  };
  const text = tasks.length > 1 ? `Retry ${tasks.length}` : 'Retry';
  return (
    <>
      <button type="button" class={main ? 'main' : ''} disabled={busy.value || tasks.length === 0} onClick={() => void send()}>{text}</button>
      {said.value && <span role="status" class="muted">{said.value}</span>}
    </>
  );
}
