// The model in 3D. three and Spark come only when this page is opened.
import { useEffect, useRef } from 'preact/hooks';
import { useSignal } from '@preact/signals';
import { get, type Download, type Job, type ModelView, type View as Photo } from '../api';
import { askFirst } from '../first';
import { bytes, count, fixed } from '../format';
import { job, jobId, jobs } from '../live';
import { href, route, setQuery } from '../route';
import { NAMES, table, version } from '../tasks';
import { Command, Empty, Panel, useGet, Waiting } from '../widgets/boundary';
import type { Look, Stage, Stats } from '../viewer/stage';

const FORMATS = ['rad', 'spz'] as const;
/** Splats at first: about as many as a picture has places for. Each further hundred thousand is 4 to 8 MB to load. */
const BUDGET = 250000;

export function View() {
  const asked = useGet<ModelView>(job.value!.model ? `/api/jobs/${jobId.value}/model` : null, job.value!.counts.done);
  const missing = useSignal('');
  if (missing.value) return <NoWebGl reason={missing.value} />;
  if (!job.value!.model) return <div class="panel"><Empty><h3>No block is finished yet</h3>The model appears with its first block, and grows as others finish. <a href={href('blocks')}>The blocks so far</a></Empty></div>;
  if (!asked.value) return <Waiting error={asked.error} what="the model" />;
  return <Scene key={jobId.value} model={asked.value} onLost={(reason) => { missing.value = reason; }} />;
}

function Scene({ model, onLost }: { model: ModelView; onLost: (reason: string) => void }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const stage = useRef<Stage | null>(null);
  const ready = useSignal(false);
  const stats = useSignal<Stats | null>(null);
  const mode = useSignal<'orbit' | 'fly'>('orbit');
  const photo = useSignal<{ view: Photo; frame: { left: number; top: number; width: number; height: number } } | null>(null);
  const { query } = route.value;
  const look = useSignal<Look>({ budget: budgetOf(query), tint: false, outlines: false, seams: false, ghosts: true });
  // The list of cameras is long; it must not delay the first picture.
  const views = useGet<{ views: Photo[] }>((stats.value?.shown ?? 0) > 0 || query.has('camera') ? `/api/jobs/${jobId.value}/views` : null, jobId.value);
  const photos = views.value?.views.filter((v) => v.camera) ?? [];
  const others = jobs.value.filter((j) => j.id !== jobId.value && j.model);
  const other = others.find((j) => String(j.id) === query.get('with'));

  useEffect(() => {
    let live = true;
    const format = FORMATS.find((f) => f === query.get('format')) ?? null;
    if (format !== 'spz') askFirst(jobId.value!, model);
    void import('../viewer/stage').then(({ Stage }) => {
      if (!live || !canvas.current) return;
      // Not before: to start a context takes a while, in which no answer of the server would be looked at.
      const reason = webgl2Missing(canvas.current);
      if (reason) { onLost(reason); return; }
      try {
        stage.current = new Stage(canvas.current, jobId.value!, model, look.value, format);
      } catch (e) { onLost((e as Error).message); return; }
      stage.current.onStats = (s) => { stats.value = s; };
      ready.value = true;
    }).catch((e: Error) => onLost(`the viewer could not be loaded: ${e.message}`));
    return () => { live = false; stage.current?.close(); stage.current = null; };
  }, []);
  useEffect(() => { stage.current?.setModel(model); }, [model]);
  useEffect(() => { stage.current?.setLook(look.value); }, [look.value, ready.value]);

  const wantedBlock = query.get('block');
  useEffect(() => { if (ready.value && wantedBlock) stage.current?.goTo(wantedBlock); }, [ready.value, wantedBlock]);
  const wantedCamera = query.get('camera');
  useEffect(() => {
    if (!ready.value || !stage.current) return;
    const view = photos.find((v) => String(v.view) === wantedCamera);
    if (view) photo.value = { view, frame: stage.current.capture(view) };
    else if (photo.value) { photo.value = null; stage.current.mover.free(); stage.current.redraw(); }
  }, [ready.value, wantedCamera, views.value]);

  const set = (change: Partial<Look>): void => { look.value = { ...look.value, ...change }; };
  const toggle = (key: 'tint' | 'outlines' | 'seams' | 'ghosts', text: string) => <label><input type="checkbox" checked={look.value[key]} onChange={(e) => set({ [key]: e.currentTarget.checked })} />{text}</label>;
  return (
    <Panel title="Viewer" aside={<a href={href('downloads')}>Downloads</a>}>
      <div class="tools">
        <label>Budget <input type="range" min="4.3" max="6.602" step="0.01" value={Math.log10(look.value.budget)} aria-valuetext={`${count(look.value.budget)} splats`}
          onInput={(e) => { const budget = Math.round(10 ** Number(e.currentTarget.value)); set({ budget }); setQuery({ budget }); }} /><span class="num" style={{ minWidth: '62px' }}>{count(look.value.budget)}</span></label>
        {toggle('tint', 'levels')}{toggle('outlines', 'outlines')}{toggle('seams', 'seams')}{toggle('ghosts', 'missing blocks')}
        <span role="group" aria-label="Movement">{(['orbit', 'fly'] as const).map((m) => <button key={m} type="button" aria-pressed={mode.value === m} onClick={() => { mode.value = m; setQuery({ camera: null }); stage.current?.mover.setMode(m); canvas.current?.focus(); }}>{m}</button>)}</span>
        <button type="button" onClick={() => { setQuery({ camera: null, block: null }); stage.current?.mover.overview(); stage.current?.redraw(); }}>Show all</button>
        {photos.length > 0 && (
          <label>Camera <select value={wantedCamera ?? ''} onChange={(e) => setQuery({ camera: e.currentTarget.value })}>
            <option value="">free</option>
            {photos.slice(0, 2000).map((v) => <option key={v.view} value={String(v.view)}>{v.name}{v.test ? ' (held out)' : ''}{v.psnr !== null ? ` ${fixed(v.psnr, 1)} dB` : ''}</option>)}
          </select></label>
        )}
        {others.length > 0 && (
          <label>Compare with <select value={String(other?.id ?? '')} onChange={(e) => setQuery({ with: e.currentTarget.value })}>
            <option value="">nothing</option>
            {others.map((j) => <option key={j.id} value={String(j.id)}>{j.id} · {j.name}</option>)}
          </select></label>
        )}
      </div>
      <div class="viewer">
        <canvas ref={canvas} tabIndex={0} role="application" aria-label="The model in 3D. Orbit: drag, wheel. Fly: W A S D, Q and E for height, shift for speed, drag to look." />
        {other && ready.value && stage.current && <Compare key={other.id} lead={stage.current} own={model} other={other} look={look.value} />}
        {!ready.value && <div class="hud">Loading the viewer …</div>}
        {(look.value.ghosts || look.value.seams) && !photo.value && <Labels stats={stats.value} />}
        {photo.value && photo.value.view.photo && <Wipe key={photo.value.view.view} {...photo.value} />}
        {photo.value && !photo.value.view.photo && <div class="hud" style={{ bottom: '48px' }}>The server has no photo of {photo.value.view.name}.</div>}
        {stats.value && <Hud s={stats.value} />}
      </div>
      <div class="legend">Orbit: drag, right-drag, wheel. Fly: W A S D, Q and E for height, shift is faster, drag looks around.
        {look.value.seams && ` Seams: from green to red, how far the pictures of the two blocks differ there, 0 to 8 levels of 255${model.faces?.length ? '' : '; plat eval --seams has not measured it'}; pink is not known.`}</div>
    </Panel>
  );
}

function Hud({ s }: { s: Stats }) {
  return (
    <div class="hud" data-testid="hud" data-shown={s.shown} data-blocks={s.blocks} data-pending={s.pending}>
      <span><b>{count(s.shown)}</b> of {count(s.total)} splats</span><span>{s.blocks} blocks{s.pending ? `, ${s.pending} loading` : ''}</span>
      <span>{fixed(s.megabytes, 1)} MB {s.format}</span><span>{s.frames ? `${fixed(s.frames, 0)} fps` : 'still'}</span>
      {s.held > 0 && <span>{s.held} finer blocks await a greater budget</span>}
      {s.errors[0] && <span style={{ color: '#ffb07a' }}>{s.errors.length > 1 ? `${s.errors.length} blocks failed: ` : ''}{s.errors[0]}</span>}
    </div>
  );
}

function Labels({ stats }: { stats: Stats | null }) {
  void version.value;
  const t = table.value;
  return (
    <div class="labels">
      {stats?.labels.map((l) => <span key={`${l.text} ${l.left}`} style={{ left: `${l.left}px`, top: `${l.top}px` }}>{l.text} {t && l.task !== null && l.task < t.length ? `${NAMES[t.state[l.task]!]}${t.progress[l.task]! > 0 ? ` ${Math.floor(t.progress[l.task]! / 10)} %` : ''}` : ''}</span>)}
    </div>
  );
}

/** Another job's model, such as the one before pruning, drawn through the same camera from the left edge to the slider. */
function Compare({ lead, own, other, look }: { lead: Stage; own: ModelView; other: Job; look: Look }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const stage = useRef<Stage | null>(null);
  const share = useSignal(50);
  const shown = useSignal(0);
  const asked = useGet<ModelView>(`/api/jobs/${other.id}/model`, other.counts.done);
  const model = asked.value;
  const apart = model !== null && !sameAxes(own, model);
  const seen = { ...look, ghosts: false, seams: false, outlines: false };
  useEffect(() => {
    if (!model || apart) return undefined;
    let live = true;
    void import('../viewer/stage').then(({ Stage }) => {
      if (!live) return;
      stage.current = new Stage(canvas.current!, other.id, model, seen, null);
      stage.current.onStats = (s) => { shown.value = s.shown; };
      stage.current.follow(lead);
    });
    return () => { live = false; stage.current?.close(); stage.current = null; };
  }, [model === null, apart]);
  useEffect(() => { if (model) stage.current?.setModel(model); }, [model]);
  useEffect(() => { stage.current?.setLook(seen); }, [look]);
  return (
    <>
      <canvas ref={canvas} aria-hidden="true" style={{ position: 'absolute', inset: 0, pointerEvents: 'none', clipPath: `inset(0 ${100 - share.value}% 0 0)` }} />
      <div class="divider" style={{ left: `${share.value}%` }} />
      <div class="hud" data-testid="compare" data-shown={shown.value} style={{ bottom: 'auto', top: '10px', left: 'auto', right: '10px' }}>
        {asked.error || (apart ? `Job ${other.id} lies on other axes than this one: the two cannot be compared.`
          : <label style={{ color: 'inherit' }}>job {other.id}, {count(shown.value)} splats <input type="range" min="0" max="100" value={share.value} aria-label={`Wipe between job ${other.id} and this one`} onInput={(e) => { share.value = Number(e.currentTarget.value); }} /> this job</label>)}
      </div>
    </>
  );
}

/** Whether two models have the same axes of the ground plane, as those of one capture have. */
function sameAxes(a: ModelView, b: ModelView): boolean {
  const [p, q] = [a.turn ?? [0, 0, 0, 1], b.turn ?? [0, 0, 0, 1]];
  return Math.abs(p.reduce((dot, v, i) => dot + v * q[i]!, 0)) > 1 - 1e-9;
}

/** The photo over the picture, from the left edge to the slider. */
function Wipe({ view, frame }: { view: Photo; frame: { left: number; top: number; width: number; height: number } }) {
  const share = useSignal(50);
  return (
    <>
      <div class="wipe"><img src={`/api/jobs/${jobId.value}/photos/${view.view}.jpg`} alt={`Photo ${view.name}`}
        style={{ left: `${frame.left}px`, top: `${frame.top}px`, width: `${frame.width}px`, height: `${frame.height}px`, clipPath: `inset(0 ${100 - share.value}% 0 0)` }} /></div>
      <div class="hud" style={{ bottom: 'auto', top: '10px' }}><label style={{ color: 'inherit' }}>photo <input type="range" min="0" max="100" value={share.value} aria-label="Wipe between photo and model" onInput={(e) => { share.value = Number(e.currentTarget.value); }} /> model</label>
        <span>{view.name}</span>{view.psnr !== null && <span>{fixed(view.psnr, 2)} dB</span>}</div>
    </>
  );
}

function NoWebGl({ reason }: { reason: string }) {
  const files = useSignal<Download[]>([]);
  useEffect(() => { get<{ files: Download[] }>('/api/downloads').then((r) => { files.value = r.files; }).catch(() => { /* the reason is told all the same */ }); }, []);
  return (
    <div class="panel"><Empty>
      <h3>The model cannot be shown in this browser</h3>
      <p>{reason}. The viewer needs WebGL2: switch on hardware acceleration, or open this page in another browser.</p>
      <p>The files can be looked at elsewhere:</p>
      <ul>{files.value.map((f) => <li key={f.path}><a href={`/files/${f.path}`} download>{f.name}</a> <span class="muted">{bytes(f.bytes)}</span></li>)}</ul>
      <p>or rendered without a browser:</p><Command>plat render MODEL --cameras CAPTURE --out DIR</Command>
    </Empty></div>
  );
}

/** Why the canvas cannot draw; otherwise it has the context that the viewer will draw with. */
function webgl2Missing(canvas: HTMLCanvasElement): string {
  if (typeof WebGL2RenderingContext === 'undefined') return 'This browser has no WebGL2';
  if (canvas.getContext('webgl2', { antialias: false, powerPreference: 'high-performance' })) return '';
  return 'This browser knows WebGL2 but could not start it (no graphics driver, or it is switched off)';
}

function budgetOf(query: URLSearchParams): number {
  const asked = Number(query.get('budget') ?? BUDGET);
  return Math.max(20000, Math.min(4e6, Number.isFinite(asked) ? asked : BUDGET));
}
