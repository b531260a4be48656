"""The incubator: its equations, records and case."""
