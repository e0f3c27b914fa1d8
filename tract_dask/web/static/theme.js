// The theme, set before anything is painted: what was chosen here last, else what the system prefers.
// A classic script in <head>, for modules run too late. `data-theme` on <html> is always "light" or "dark".
(() => {
  const KEY = "tract_dask.theme";
  const root = document.documentElement;
  const system = matchMedia("(prefers-color-scheme: dark)");
  const chosen = () => { try { return localStorage.getItem(KEY); } catch { return null; } };

  function apply() {
    const theme = chosen() ?? (system.matches ? "dark" : "light");
    if (root.dataset.theme === theme) return;
    root.dataset.theme = theme;
    document.dispatchEvent(new Event("themechange"));
  }

  function toggle() {
    const theme = root.dataset.theme === "dark" ? "light" : "dark";
    const preferred = system.matches ? "dark" : "light";
    try {
      if (theme === preferred) localStorage.removeItem(KEY);
      else localStorage.setItem(KEY, theme);
    } catch { /* without storage the choice holds for this page */ }
    root.dataset.theme = theme;
    document.dispatchEvent(new Event("themechange"));
  }

  apply();
  system.addEventListener("change", apply);
  addEventListener("storage", (event) => { if (event.key === KEY) apply(); });
  document.addEventListener("click", (event) => { if (event.target instanceof Element && event.target.closest("[data-theme-toggle]")) toggle(); });
})();
