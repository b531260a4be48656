"""The Silverbox benchmark: its equations, records and case."""
