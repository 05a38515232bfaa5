"""Reports: results as metrics.json, HTML, figures and comparisons."""
