export function Block() { return <div class="empty">Block</div>; }
