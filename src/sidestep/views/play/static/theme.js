// Colours: those of the style sheet, for the canvas too; light, dark, or as the computer is set.

const NAMES = [
  "evader", "evaderLight", "evaderFaint", "evaderText", "pursuer", "pursuerLight", "pursuerFaint", "obstacle",
  "obstacleFaint", "obstacleHatch", "target", "targetFaint", "correction", "plan", "wish", "level", "grid",
  "gridStrong", "arena", "ink", "soft", "paper", "metal", "tyre", "tread", "shadow", "rowsDisc",
];
const KEY = "sidestep-theme";

export const THEMES = ["auto", "light", "dark"];

export function readColours() {
  const style = getComputedStyle(document.documentElement);
  return Object.fromEntries(NAMES.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

export function themeOf() {
  try {
    const kept = localStorage.getItem(KEY);
    return THEMES.includes(kept) ? kept : "auto";
  } catch {
    return "auto";
  }
}

export function setTheme(theme, changed) {
  if (theme === "auto") delete document.documentElement.dataset.theme;
  else document.documentElement.dataset.theme = theme;
  try {
    localStorage.setItem(KEY, theme);
  } catch {
    // Private windows may refuse; the choice then lasts until the page is closed.
  }
  changed();
}

export function watchTheme(changed) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", changed);
}
