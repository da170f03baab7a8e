"""C for flight controllers and logs: estimators and allocators (export_c), the whole default diagnoser (export_diagnoser, with embedded_c),
and the same with readers of logs (export_log_reader, with log_reader_c)."""
