"""What all pages of reports look like: one file that loads nothing and runs nothing."""

from __future__ import annotations

PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8">{mark}<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title} – xalign report</title><style>:root{{color-scheme:light}}
body{{margin:0 auto;max-width:46rem;padding:2rem 1rem 4rem;font:1rem/1.5 system-ui,sans-serif;color:#222}}
h1,h2{{font-weight:600;line-height:1.2;margin:2.5rem 0 .75rem}} h1{{font-size:1.75rem;margin-top:0}}
h2{{font-size:1.25rem}} h1,p,th,td{{overflow-wrap:anywhere}} .lead{{font-size:1.125rem}}
table{{border-collapse:collapse;width:100%}} th,td{{border-top:1px solid #e4e4e4;padding:.4rem 0;vertical-align:top}}
th{{font-weight:400;padding-right:1rem;text-align:left;width:68%}} small{{display:block}} td code{{font-size:.8125rem}}
td{{font-variant-numeric:tabular-nums;text-align:right}} small,figcaption,.quiet{{color:#5f5f5f}}
i{{border-radius:2px;display:inline-block;height:.7rem;width:.7rem}}
svg{{border-radius:3px;display:block;height:1.25rem;margin:1.25rem 0 .75rem;width:100%}}
figure{{margin:2.5rem 0 0}} img{{display:block;height:auto;width:100%}}
</style></head><body>
{body}
</body></html>
"""
