// The one line that says how the robot is: the worst of what is known, and why it stands.

const OLD_S = 3; // without a scan

// link: {isLive, text}; returns [class, text].
export function statusOf(items, link) {
  if (!link.isLive) return ['bad', link.text];
  if (items.get('held')) return ['bad', `stopped: ${items.get('held_by') || 'by a page'}`];
  const age = items.get('scan_age') ?? 0;
  if (age > OLD_S) return ['bad', `no scan for ${age} s`];
  const slam = items.get('slam');
  if (slam && !slam.is_well) return ['bad', `${slam.state}: ${slam.detail}`];
  const [level, name, message] = (items.get('diagnostics') ?? [])[0] ?? ['OK'];
  const words = [link.text, slam?.state, doing(items)].filter(Boolean).join(' · ');
  if (level === 'OK') return ['', words];
  return [level === 'WARN' ? 'warn' : 'bad', `${name.replace(/: thinmap$/, '')}: ${message}`];
}

function doing(items) {
  if (items.get('goal')) return 'driving to the goal';
  const exploration = items.get('exploration');
  return exploration ? `${exploration.state}, ${exploration.detail}` : '';
}
