"""C for flight controllers: estimators and allocators (export_c), and the whole default diagnoser (export_diagnoser, with embedded_c)."""
