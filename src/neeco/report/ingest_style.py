"""What the ingest page adds to the report's style sheet."""

INGEST_STYLE = """
.verdict { max-width: none; } .verdict.good { border-color: var(--good); } .verdict.bad { border-color: var(--bad); }
.verdict.careful { border-color: var(--phase); } .verdict b { font-size: 1.1rem; font-weight: 600; }
ul.note { max-width: 84ch; padding-left: 1.3em; margin: 6px 0; } ul.note li { margin: 3px 0; }
.samples { display: grid; grid-template-columns: repeat(auto-fill, minmax(250px, 1fr)); gap: 12px; margin: 12px 0; }
.histograms { display: grid; grid-template-columns: repeat(auto-fill, minmax(290px, 1fr)); gap: 12px; }
.histograms svg { width: 100%; height: auto; background: var(--card); border: 1px solid var(--edge);
  border-radius: 10px; }
.s-train { fill: var(--accent); background: var(--accent); } .s-test { fill: var(--good); background: var(--good); }
.s-unseen { fill: var(--phase); background: var(--phase); } .s-other { fill: var(--soft); background: var(--soft); }
.beyond { fill: var(--phase); opacity: .13; }
svg .dots { fill: none; stroke: var(--accent); stroke-width: 3.2; stroke-linecap: round; opacity: .65; }
svg .rms { stroke: var(--phase); stroke-dasharray: 5 3; }
.t-points { fill: none; stroke: var(--soft); stroke-width: 1.7; stroke-linecap: round; opacity: .55; }
.t-camera, .t-rays, .t-first, .t-second, .t-third, .t-scale { fill: none; stroke-width: 1.8; stroke-linejoin: round; }
.t-camera { stroke: var(--accent); } .t-rays { stroke: var(--accent); stroke-width: 1; opacity: .7; }
.t-first { stroke: var(--phase); } .t-second { stroke: var(--good); } .t-third { stroke: var(--bad); }
.t-scale { stroke: var(--ink); stroke-width: 2; }
.key i.x { background: #ff5252; } .key i.y { background: #4cd964; } .key i.z { background: #4aa8ff; }
.key i.shape { background: #ffe14a; border: 1px solid #888; } .key i.main { background: #ff6bff; }
.key i.camera { background: var(--accent); } .key i.line0 { background: var(--phase); }
.key i.line1 { background: var(--good); } .key i.line2 { background: var(--bad); }
p:not(.soft) .key i { margin-left: 3px; }
.turning canvas { width: 100%; aspect-ratio: 420 / 320; display: block; background: var(--card);
  border: 1px solid var(--edge); border-radius: 10px; cursor: grab; touch-action: pan-y; }
.key i:first-child { margin-left: 0; }
.turning[hidden] { display: none; }
table.dropped td, table.dropped th { white-space: normal; vertical-align: top; position: static; }
th.wide, td.wide { text-align: left; width: 55%; overflow-wrap: anywhere; }
.made dt { max-width: 40vw; }
"""
