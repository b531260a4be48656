"""The form of a discrepancy inside state equations: its terms, their domain, its curves."""
