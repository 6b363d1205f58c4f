// Everything that happened, newest first.
import { useEffect } from 'preact/hooks';
import { useComputed, useSignal } from '@preact/signals';
import { get, type Event } from '../api';
import { save } from '../format';
import { events, jobId } from '../live';
import { route, setQuery } from '../route';
import { table } from '../tasks';
import { Panel } from '../widgets/boundary';
import { EventRow } from '../widgets/feed';

export function Events() {
  const { query } = route.value;
  const older = useSignal<Event[]>([]);
  const shown = useSignal(300);
  const id = jobId.value;
  useEffect(() => {
    older.value = [];
    if (id !== null) get<{ lines: Event[] }>(`/api/jobs/${id}/log?after=0`).then((r) => { older.value = r.lines; }).catch(() => { /* the live events are shown all the same */ });
  }, [id]);
  const failedOnly = query.get('failed') === '1';
  const worker = query.get('worker') ?? '';
  const block = query.get('block') ?? '';
  const text = query.get('text') ?? '';
  const all = useComputed(() => {
    const byNumber = new Map<number, Event>();
    for (const e of [...older.value, ...events.value]) byNumber.set(e.number, e);
    return [...byNumber.values()].sort((a, b) => b.number - a.number);
  });
  const names = [...new Set(all.value.map((e) => e.worker).filter(Boolean))].sort();
  const t = table.value;
  const kept = all.value.filter((e) => (!failedOnly || e.level !== 'info') && (!worker || e.worker === worker)
    && (!block || (e.task !== null && (t && e.task < t.length ? t.name(e.task) : String(e.task)).startsWith(block))) && (!text || e.what.toLowerCase().includes(text.toLowerCase())));
  return (
    <Panel title="Events" aside={
      <>
        <label><input type="checkbox" checked={failedOnly} onChange={(e) => setQuery({ failed: e.currentTarget.checked ? 1 : null })} />failures and warnings only</label>
        <label>Worker <select value={worker} onChange={(e) => setQuery({ worker: e.currentTarget.value })}><option value="">all</option>{names.map((n) => <option key={n}>{n}</option>)}</select></label>
        <label>Block <input type="search" size={8} placeholder="3/1" value={block} onInput={(e) => setQuery({ block: e.currentTarget.value })} /></label>
        <label>Text <input type="search" size={12} value={text} onInput={(e) => setQuery({ text: e.currentTarget.value })} /></label>
        <button type="button" onClick={() => save('events.ndjson', kept.map((e) => JSON.stringify(e)).join('\n'), 'application/x-ndjson')}>NDJSON</button>
        <span class="num">{kept.length} of {all.value.length}</span>
      </>
    }>
      {kept.length === 0 ? <div class="empty">{all.value.length ? 'No event matches the filter.' : 'Nothing has happened yet.'}</div>
        : <ul class="rows feed" data-testid="events">{kept.slice(0, shown.value).map((e) => <EventRow key={e.number} event={e} withJob />)}</ul>}
      {kept.length > shown.value && <div class="body"><button type="button" onClick={() => { shown.value += 500; }}>Show 500 more</button></div>}
    </Panel>
  );
}
