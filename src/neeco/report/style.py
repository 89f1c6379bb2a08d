"""The reports' style sheets and the page about them: light and dark, phone to print, nothing fetched."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

STYLE = """
:root { color-scheme: light dark; --ink: #1c2024; --soft: #5c656e; --paper: #ffffff; --card: #f5f6f8; --edge: #dde1e6;
  --accent: #0b6e99; --phase: #b3541e; --good: #1a7f4b; --bad: #b3261e; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e9ec; --soft: #9aa4ae; --paper: #14171a; --card: #1d2125;
  --edge: #333a41; --accent: #5bb8e0; --phase: #eb9a5f; --good: #6ccf98; --bad: #ff8a80; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 1120px; padding: 28px 20px 60px; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { font-size: 1.75rem; line-height: 1.2; margin: 0 0 4px; }
h2 { font-size: 1.2rem; margin: 40px 0 8px; padding-top: 14px; border-top: 1px solid var(--edge); }
h3 { font-size: 1rem; margin: 22px 0 6px; }
p { max-width: 72ch; margin: 6px 0; }
.soft, figcaption, dd, .note { color: var(--soft); font-size: .9rem; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 10px; margin: 18px 0; }
.tile { background: var(--card); border: 1px solid var(--edge); border-radius: 10px; padding: 10px 14px; }
.tile b { display: block; font-size: 1.5rem; font-weight: 650; font-variant-numeric: tabular-nums; }
.tile span { color: var(--soft); font-size: .85rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; width: 100%; font-size: .92rem; }
th, td { text-align: right; padding: 6px 10px; border-bottom: 1px solid var(--edge); white-space: nowrap; }
th { font-weight: 600; color: var(--soft); vertical-align: bottom; }
th:first-child, td:first-child { text-align: left; position: sticky; left: 0; background: var(--paper); }
tr.group td { font-weight: 650; color: var(--accent); padding-top: 16px; }
.made { display: grid; grid-template-columns: max-content 1fr; gap: 2px 18px; margin: 10px 0; font-size: .92rem; }
.made dt { color: var(--soft); } .made dd { margin: 0; color: var(--ink); overflow-wrap: anywhere; }
.explain dt { font-weight: 600; margin-top: 8px; } .explain dd { margin: 0; max-width: 80ch; }
.curves { display: grid; grid-template-columns: repeat(auto-fit, minmax(290px, 1fr)); gap: 14px; }
.curves svg { width: 100%; height: auto; background: var(--card); border: 1px solid var(--edge); border-radius: 10px; }
svg text { fill: var(--soft); font-size: 11px; font-family: inherit; } svg .title { fill: var(--ink);
  font-size: 12px; }
svg .grid { stroke: var(--edge); } svg .line { fill: none; stroke: var(--accent); stroke-width: 1.8; }
svg .end { fill: var(--accent); } svg .phase { stroke: var(--phase); stroke-dasharray: 4 3; }
  svg .phase-name { fill: var(--phase); }
.frame > p { max-width: none; }
.row { display: grid; grid-template-columns: repeat(4, 1fr); gap: 8px; margin: 4px 0 2px; }
figure { margin: 0; break-inside: avoid; } figure img { width: 100%; height: auto; display: block;
  border-radius: 6px; }
.frame { margin: 0 0 18px; break-inside: avoid; } .frame > p { margin: 0; }
.tag { display: inline-block; border: 1px solid var(--edge); border-radius: 99px; padding: 0 9px;
  font-size: .8rem; color: var(--soft); }
.key i { display: inline-block; width: 12px; height: 12px; border-radius: 3px; margin: 0 5px 0 14px;
  vertical-align: -1px; }
.verdict { background: var(--card); border-left: 4px solid var(--accent); padding: 8px 14px;
  border-radius: 0 8px 8px 0; }
.preview { width: 100%; height: auto; border-radius: 8px; }
details summary { cursor: pointer; color: var(--accent); }
pre { background: var(--card); border: 1px solid var(--edge); border-radius: 8px; padding: 10px; overflow-x: auto;
  font-size: .82rem; }
@media (max-width: 640px) { body { padding: 18px 14px 40px; } .row { grid-template-columns: repeat(2, 1fr); }
  h1 { font-size: 1.4rem; } }
@media print { :root { --ink: #000; --soft: #444; --paper: #fff; --card: #fff; --edge: #bbb; --accent: #04506f;
  --phase: #7a3410; }
  body { max-width: none; padding: 0; font-size: 11pt; } h2, h2 + p, h2 + p + p { break-after: avoid; }
  p { break-inside: avoid; } .scroll { overflow: visible; }
  table { font-size: 8.5pt; } th, td { padding: 3px 5px; } .curves { grid-template-columns: repeat(3, 1fr); }
  * { print-color-adjust: exact; -webkit-print-color-adjust: exact; } }
"""

CHART_STYLE = """
:root { --m0: #0072b2; --m1: #c24e00; --m2: #00805c; --m3: #a83f82; --m4: #6f6300; --m5: #5a4fcf; --m6: #4d4d4d; }
@media (prefers-color-scheme: dark) { :root { --m0: #5ab4e8; --m1: #ff9a57; --m2: #4cd3a5; --m3: #ef9fcb;
  --m4: #e3cf55; --m5: #aaa3ff; --m6: #c8c8c8; } }
@media print { :root { --m0: #005b8e; --m1: #a34000; --m2: #006a4c; --m3: #8a2f69; --m4: #574d00; --m5: #453ab0;
  --m6: #333; } }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 400px), 1fr)); gap: 14px; }
.charts svg { width: 100%; height: auto; background: var(--card); border: 1px solid var(--edge); border-radius: 10px;
  break-inside: avoid; }
svg .main { fill: none; stroke-width: 2; } svg .faint { fill: none; stroke-width: .7; opacity: .55; }
svg .dot { fill: none; stroke-width: 1; opacity: .45; } svg text.name { font-size: 11px; }
.legend { display: flex; flex-wrap: wrap; gap: 4px 18px; margin: 6px 0; font-size: .9rem; padding: 0; }
.legend svg { width: 46px; height: 14px; vertical-align: -2px; margin-right: 6px; }
.legend svg .dot { stroke-width: 1.2; opacity: 1; }
.best { font-weight: 700; color: var(--good); } td small { color: var(--soft); font-size: .82em; }
td.failed { text-align: left; color: var(--bad); white-space: normal; }
.shots { display: grid; grid-template-columns: repeat(auto-fill, minmax(215px, 1fr)); gap: 12px 10px; margin: 6px 0; }
@media screen and (min-width: 1000px) {
  .shots:has(> :nth-child(5):last-child) { grid-template-columns: repeat(5, 1fr); } }
.shots img + img { margin-top: 4px; }
.download { font-size: .85rem; color: var(--accent); margin-right: 14px; }
.verdicts li { margin: 4px 0; max-width: 80ch; }
@media (max-width: 640px) { .shots { grid-template-columns: repeat(2, 1fr); } }
@media print { .download { display: none; } .best { color: #000; } .shots { grid-template-columns: repeat(4, 1fr); }
  .charts { grid-template-columns: repeat(2, 1fr); } h3 { break-after: avoid; }
  .scroll, figure { break-inside: avoid; } }
"""


def html_page(title: str, style: str, sections: Sequence[str]) -> str:
    """A whole page of the sections that are not empty."""
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{style}</style></head><body>\n"
        + "\n".join(section for section in sections if section)
        + "\n</body></html>\n"
    )
