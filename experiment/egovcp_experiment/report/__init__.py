"""Reports: what an experiment found, as JSON, Markdown and a page that needs nothing else."""
