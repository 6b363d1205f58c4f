// What this browser keeps, and what the server is.
import { link, server, skewMillis } from '../live';
import { calm, theme, type Theme } from '../settings';
import { Panel } from '../widgets/boundary';

export function Settings() {
  const s = server.value;
  return (
    <div class="cols">
      <Panel title="This browser" class="w6">
        <div class="body">
          <dl class="facts" style={{ gap: '10px 16px', alignItems: 'center' }}>
            <dt>Theme</dt>
            <dd><span role="radiogroup" aria-label="Theme">
              {(['system', 'light', 'dark'] as Theme[]).map((t) => <label key={t} style={{ marginRight: '14px' }}><input type="radio" name="theme" value={t} checked={theme.value === t} onChange={() => { theme.value = t; }} />{t}</label>)}
            </span></dd>
            <dt>Motion</dt>
            <dd><label><input type="checkbox" checked={calm.value} onChange={(e) => { calm.value = e.currentTarget.checked; }} />reduce motion, whatever the system says</label></dd>
          </dl>
        </div>
      </Panel>
      <Panel title="The server" class="w6">
        <div class="body">
          <dl class="facts">
            <dt>Version</dt><dd>{s?.version ?? '–'}</dd>
            <dt>Serves</dt><dd>{s ? { train: 'a training on this machine', coordinator: 'a coordinator', folder: 'a folder' }[s.kind] : '–'}</dd>
            <dt>Store</dt><dd>{s?.store_url ?? 'none'}</dd>
            <dt>Controls</dt><dd>{s?.controls ? 'jobs can be paused, cancelled and retried here' : 'read only'}</dd>
            <dt>Link</dt><dd>{link.value}</dd>
            <dt>Clock</dt><dd>{Math.abs(skewMillis.value) < 2000 ? 'agrees with this browser' : `${(skewMillis.value / 1000).toFixed(0)} s apart; ages use the server's`}</dd>
            <dt>Plain page</dt><dd><a href="/status">/status</a>, without JavaScript</dd>
            <dt>Licences</dt><dd><a href="licences.txt">of what these pages contain</a></dd>
          </dl>
        </div>
      </Panel>
    </div>
  );
}
