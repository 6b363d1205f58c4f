// What is on every page: the job and its phase, the age of what is shown, and the three banners.
import type { ComponentType } from 'preact';
import { useEffect } from 'preact/hooks';
import { useComputed, useSignal } from '@preact/signals';
import { events, job, jobs, link, loaded, nowMillis, server, serverNow, silentMillis, workers } from './live';
import { fixed, percent, left, span } from './format';
import { problems } from './problems';
import { href, route, setQuery } from './route';
import { still } from './settings';
import { table, version } from './tasks';
import { Boundary, Command, Empty } from './widgets/boundary';
import { lazy } from './widgets/lazy';
import { Overview } from './pages/overview';
import { Blocks } from './pages/blocks';
import { Compare } from './pages/compare';
import { Cluster } from './pages/cluster';
import { Events } from './pages/events';
import { Downloads } from './pages/downloads';
import { Settings } from './pages/settings';
import { View } from './pages/view';

const PAGES: { path: string; title: string; component: ComponentType; anyJob?: boolean }[] = [
  { path: '', title: 'Overview', component: Overview },
  { path: 'blocks', title: 'Blocks', component: Blocks },
  { path: 'block', title: 'Block', component: lazy(() => import('./pages/block').then((m) => m.Block)) },
  { path: 'compare', title: 'Speed and accuracy', component: Compare, anyJob: true },
  { path: 'cluster', title: 'Cluster', component: Cluster, anyJob: true },
  { path: 'view', title: 'Viewer', component: View },
  { path: 'events', title: 'Events', component: Events, anyJob: true },
  { path: 'downloads', title: 'Downloads', component: Downloads, anyJob: true },
  { path: 'settings', title: 'Settings', component: Settings, anyJob: true },
];

export function Shell() {
  const { page, argument } = route.value;
  const current = PAGES.find((p) => p.path === page);
  const title = current?.title ?? 'Not found';
  useEffect(() => { document.title = `${page === 'block' ? `Block ${argument}` : title} · plat`; }, [title, argument]);
  const state = link.value;
  useEffect(() => { document.documentElement.dataset['link'] = state; }, [state]);

  return (
    <>
      <a class="skip" href="#content" onClick={(e) => { e.preventDefault(); document.getElementById('content')?.focus(); }}>To the content</a>
      <div class="top">
        <Header />
        <nav class="pages" aria-label="Pages">
          {PAGES.filter((p) => p.path !== 'block').map((p) => (
            <a key={p.path} href={href(p.path)} aria-current={p.path === page || (p.path === 'blocks' && page === 'block') ? 'page' : undefined}>{p.title}</a>
          ))}
        </nav>
        <Banners />
      </div>
      <main id="content" tabIndex={-1}>
        <h1 class="hidden">{title}</h1>
        <Boundary key={`${page}/${argument}`}>
          {!current ? <Empty><h3>No such page</h3><a href={href('')}>To the overview</a></Empty>
            : !loaded.value ? <Empty>Waiting for the server …</Empty>
              : !current.anyJob && !job.value ? <NoJob /> : <current.component />}
        </Boundary>
      </main>
    </>
  );
}

function Header() {
  const now = job.value;
  const live = workers.value.filter((w) => w.state === 'busy' || w.state === 'idle').length;
  const known = workers.value.filter((w) => w.state !== 'left').length;
  const count = useComputed(() => {
    void version.value;
    return problems(job.value, table.value, workers.value, events.value).length;
  });
  return (
    <header class="bar">
      <a class="brand" href={href('')}>plat</a>
      {jobs.value.length > 0 && (
        <label>Job
          <select value={String(now?.id ?? '')} onChange={(e) => setQuery({ job: e.currentTarget.value })}>
            {!now && <option value="">none</option>}
            {jobs.value.map((j) => <option key={j.id} value={String(j.id)}>{j.id} · {j.name} · {j.state}</option>)}
          </select>
        </label>
      )}
      {now && <Phases />}
      {now && <span><b class="num">{now.phase === 'detect' ? percent(now.photos_done, now.photos_all) : percent(now.steps_done, now.steps_all)}</b> <span class="muted">{eta()}</span></span>}
      <span class="push muted">
        {known > 0 && <a href={href('cluster')}><span class="num">{live} of {known}</span> workers</a>}
      </span>
      <a class={count.value ? 'warn' : 'muted'} href={href('', {})} aria-label={`${count.value} problems`}>
        {count.value ? `▲ ${count.value}` : '✓ 0'} {count.value === 1 ? 'problem' : 'problems'}
      </a>
      <Badge />
    </header>
  );
}

function eta(): string {
  const now = job.value;
  if (!now || now.state !== 'running') return now?.state ?? '';
  return !now.eta_seconds ? 'time left unknown' : now.eta_seconds[1] < 1 ? left(...now.eta_seconds) : `${left(...now.eta_seconds)} left`;
}

function Phases() {
  const now = job.value!;
  const names = [...(now.detections ? ['detect'] : []), 'train', 'evaluate', 'merge', 'done'];
  const at = names.indexOf(now.phase);
  return (
    <ol class="phases" aria-label="Phases">
      {names.map((name, i) => (
        <li key={name} class={i < at || now.phase === 'done' ? 'past' : i === at ? 'now' : ''} aria-current={i === at ? 'step' : undefined}>
          {i < at || now.phase === 'done' ? '✓ ' : ''}{name}
        </li>
      ))}
    </ol>
  );
}

function Badge() {
  const seconds = silentMillis.value / 1000;
  const text = { connecting: 'Connecting', live: 'Live', stale: `Stale ${fixed(seconds, 0)} s`, disconnected: seconds < 1 ? 'Disconnected' : `Disconnected ${span(Math.round(seconds))}` }[link.value];
  // A beat once a second instead of an animation: that would make the browser compose the whole page sixty times a second.
  const beat = link.value === 'live' && !still.value && Math.floor(nowMillis.value / 1000) % 2 === 1;
  return <span class={`badge ${link.value}${beat ? ' beat' : ''}`} data-testid="link"><i />{text}</span>;
}

/** Three things can be lost, and each needs another answer: a worker, the coordinator, this browser's connection. */
function Banners() {
  const dismissed = useSignal(new Set<string>());
  const gone = workers.value.filter((w) => w.state === 'lost' && !dismissed.value.has(w.name));
  const coordinator = server.value?.coordinator;
  const state = link.value;
  return (
    <div aria-live="polite">
      {state === 'disconnected' && (
        <div class="banner bad" data-testid="browser-lost"><b>This browser has lost the server.</b>
          The numbers are {span(Math.max(1, Math.round(silentMillis.value / 1000)))} old. Training goes on without this page; it connects again by itself.</div>
      )}
      {state !== 'disconnected' && coordinator && !coordinator.reachable && (
        <div class="banner bad" data-testid="coordinator-lost"><b>The coordinator is silent</b> for {span(coordinator.silent_millis / 1000)} ({coordinator.url}).
          Workers finish the attempts they hold; no new task is given out until it is back.</div>
      )}
      {state !== 'disconnected' && gone.length > 0 && (
        <div class="banner" data-testid="worker-lost"><b>{gone.length === 1 ? `Worker ${gone[0]!.name} is lost.` : `${gone.length} workers are lost.`}</b>
          Last heard {span((serverNow.value - Math.max(...gone.map((w) => w.heard_unix_ms))) / 1000)} ago. {job.value?.state === 'running' ? gone.length === 1 ? 'Its task goes to another worker.' : 'Their tasks go to others.' : ''}
          {' '}<a href={href('cluster')}>Cluster</a>
          <button type="button" class="quiet" onClick={() => { dismissed.value = new Set([...dismissed.value, ...gone.map((w) => w.name)]); }}>Dismiss</button></div>
      )}
    </div>
  );
}

function NoJob() {
  const wanted = route.value.query.get('job');
  const kind = server.value?.kind;
  const url = server.value?.coordinator?.url ?? 'URL';
  if (wanted !== null && jobs.value.length > 0) return <Empty><h3>There is no job {wanted}</h3><a href={href('', { job: null })}>Show the jobs there are</a></Empty>;
  return (
    <div class="panel"><Empty>
      <h3>No job yet</h3>
      {kind === 'coordinator' && <><p>Submit a capture to this coordinator:</p><Command>{`plat submit CAPTURE --coordinator ${url}`}</Command></>}
      {kind === 'coordinator' && workers.value.length === 0 && <><p>and start a worker on each machine:</p><Command>{`plat worker --coordinator ${url}`}</Command></>}
      <p>{kind === 'coordinator' ? 'Or train on one machine:' : 'Train a capture, and watch it here:'}</p><Command>plat train CAPTURE --out DIR --serve</Command>
      <p>No capture at hand? A small synthetic city, trained and served:</p><Command>plat demo</Command>
    </Empty></div>
  );
}
