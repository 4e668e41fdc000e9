"""The page for exploring: traces, residual maps and tables of a run in one offline HTML file."""
