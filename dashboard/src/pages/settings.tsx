export function Settings() { return <div class="empty">Settings</div>; }
