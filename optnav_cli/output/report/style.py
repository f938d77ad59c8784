"""Colours and the look of drawings, shared by pages and by pictures that stand alone."""

LIGHT = """--paper: #ffffff; --ink: #1b2330; --soft: #5b6675;
  --rule: #d8dee6; --tile: #f3f6f9; --none: #c4cad2; --edge: transparent;
  --c1: #1f6fb2; --c2: #c2571a; --c3: #23824e; --c4: #b3273f; --c5: #7549a8;"""
DARK = """--paper: #12161c; --ink: #e4e9f0; --soft: #98a4b3;
  --rule: #2c3541; --tile: #1b222b; --none: #39424e; --edge: #98a4b399;
  --c1: #5eb0f0; --c2: #f29a5c; --c3: #5fc98c; --c4: #f2708a; --c5: #b994ea;"""
PRINTED = """--paper: #ffffff; --ink: #000000; --soft: #444444;
  --rule: #cccccc; --tile: #f3f3f3; --none: #cccccc; --edge: transparent;
  --c1: #1f6fb2; --c2: #c2571a; --c3: #23824e; --c4: #b3273f; --c5: #7549a8;"""

DRAWINGS = """
svg text { fill: var(--ink); font: 12px system-ui, "DejaVu Sans", sans-serif; }
svg text.tick { fill: var(--soft); font-size: 11px; }
svg .grid { stroke: var(--rule); stroke-width: 1; }
svg .frame { fill: none; stroke: var(--soft); stroke-width: 1; }
svg .line { fill: none; stroke-width: 1.6; stroke: var(--ink); } svg .thin { stroke-width: .8; }
svg .dashed { stroke-dasharray: 5 4; }
svg .band { stroke: none; fill-opacity: .16; }
svg .bar { fill-opacity: .8; } svg .bar.full, svg .bar.seamless { fill-opacity: 1; }
svg .bar.full { stroke: var(--edge); stroke-width: .6; }
svg .bar.seamless { shape-rendering: crispEdges; }
svg .line.median { stroke: var(--ink); stroke-dasharray: 4 3; stroke-width: 1.2; }
svg .line.s1, svg .mark.s1 { stroke: var(--c1); } svg .line.s2, svg .mark.s2 { stroke: var(--c2); }
svg .line.s3, svg .mark.s3 { stroke: var(--c3); } svg .line.s4, svg .mark.s4 { stroke: var(--c4); }
svg .line.s5, svg .mark.s5 { stroke: var(--c5); } svg .mark.muted { stroke: var(--soft); }
svg .line.muted { stroke: var(--soft); } svg .line.faint { stroke: var(--soft); opacity: .35; }
svg .line.graticule { stroke: #ffffff; stroke-opacity: .45; stroke-width: .8; }
svg .line.scale { stroke: #ffffff; stroke-width: 2.5; }
svg .line.rim { stroke: var(--soft); stroke-width: 1.4; } svg .area.ground { fill: var(--none); }
svg text.halo { fill: #ffffff; paint-order: stroke; stroke: #00000099; stroke-width: 2.5px; }
svg .dot.ringed { stroke: #10151c; stroke-width: 1.2; }
svg .s1 { fill: var(--c1); } svg .s2 { fill: var(--c2); } svg .s3 { fill: var(--c3); }
svg .s4 { fill: var(--c4); } svg .s5 { fill: var(--c5); } svg .muted { fill: var(--soft); }
svg .line, svg .mark.stroke { fill: none; } svg .mark.hollow { fill: var(--paper); }
svg .mark { stroke-width: 1.3; } svg .mark.stroke { stroke-width: 1.8; }
"""
