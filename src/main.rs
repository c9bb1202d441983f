//! The `lunarray` command; everything it does is in the library.

fn main() -> std::process::ExitCode {
    lunarray::cli::main()
}
