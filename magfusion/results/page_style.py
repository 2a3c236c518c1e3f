"""Style of pages: one style sheet, for screen and paper."""

STYLE = """
.page{margin:0 auto;max-width:1080px;padding:0 20px 40px;background:#fff;color:#1d2530;
 font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,"DejaVu Sans",sans-serif}
h1{font-size:22px;margin:24px 0 12px;overflow-wrap:anywhere}
h2{font-size:17px;margin:34px 0 8px;padding-bottom:4px;border-bottom:1px solid #d7dce3}
p{margin:6px 0;max-width:80ch}
code{font-size:12px;color:#5b6675}
.verdict{border-left:8px solid;border-radius:4px;padding:12px 18px}
.verdict strong{font-size:24px;letter-spacing:.04em}
.verdict ul{margin:8px 0 0;padding-left:20px}
.trustworthy{background:#e8f6ec;border-color:#1a7f37}.trustworthy strong{color:#14662c}
.doubtful{background:#fff6dd;border-color:#c98a00}.doubtful strong{color:#8a5a00}
.failed{background:#fdeaea;border-color:#c62828}.failed strong{color:#a31515}
.none{background:#eef1f5;border-color:#8793a3}
table{border-collapse:collapse;margin:8px 0;font-variant-numeric:tabular-nums}
th,td{padding:3px 14px 3px 0;text-align:left;vertical-align:top;border-bottom:1px solid #eceff3;
 overflow-wrap:break-word}
th{font-weight:600;color:#48525f}td.n,th.n{text-align:right}
tr.far td{background:#fff6dd}
.wide{overflow-x:auto}
.charts>.wide{max-width:100%;padding-right:30px}
.charts{display:flex;flex-wrap:wrap;gap:14px 10px;align-items:flex-start}
figure{margin:0}figure img{max-width:100%;height:auto}
figcaption{font-size:12px;color:#48525f;padding-left:62px}
figcaption span{margin-right:14px;white-space:nowrap}
figcaption i{display:inline-block;width:16px;height:3px;margin-right:5px;vertical-align:middle}
svg{max-width:100%;height:auto}
svg text{font-size:11px;fill:#48525f}
svg .title{font-size:12.5px;font-weight:600;fill:#1d2530}
svg .middle{text-anchor:middle}svg .end{text-anchor:end}
svg .name{fill:#1d2530;font-weight:600;paint-order:stroke;stroke:#fff;stroke-width:3px}
.grid{stroke:#e6e9ee;fill:none}.frame{stroke:#9aa5b3;fill:none}
.line{fill:none;stroke-width:1.5;stroke-linejoin:round}
.dots{fill:none;stroke-width:2.6;stroke-linecap:round}
.band{fill:#c9d8ee;stroke:none}i.band{background:#c9d8ee;height:10px}
.estimate{stroke:#1f5fbf}i.estimate{background:#1f5fbf}
.truth{stroke:#111;stroke-dasharray:5 4;stroke-width:1.1}i.truth{background:#111}
.error{stroke:#c0392b;stroke-width:1.2}i.error{background:#c0392b}
.sigma{stroke:#1f5fbf}i.sigma{background:#1f5fbf}
.level{stroke:#c98a00}i.level{background:#c98a00}
.expected{stroke:#1a7f37;stroke-dasharray:4 3}
.beacon{fill:#7b3fb0;stroke:#fff}.start{fill:#1a7f37;stroke:#fff}
details summary{cursor:pointer;color:#1f5fbf}
@media (max-width:600px){.page{padding:0 12px 24px}th,td{padding-right:7px;font-size:12px}
 .verdict{padding:10px 12px}figcaption{padding-left:0}
 figure{overflow-x:auto}figure img{max-width:760px}}
@media print{.page{max-width:none}figure,table{break-inside:avoid}}
"""
