//! Generates the messages and the service with protox, which needs no protoc, and lists all calls, fields and values for the test that
//! compares them with `wire.txt`.

use std::fmt::Write;
use std::path::Path;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let descriptors = protox::compile(["proto/plat.proto"], ["proto"])?;
    let mut list = String::new();
    for file in &descriptors.file {
        for service in &file.service {
            for call in &service.method {
                let stream = if call.server_streaming() { "stream " } else { "" };
                writeln!(list, "call {} {} {stream}{}", call.name(), call.input_type(), call.output_type())?;
            }
        }
        for message in &file.message_type {
            for field in &message.field {
                let kind = format!("{:?} {:?} {}", field.label(), field.r#type(), field.type_name());
                writeln!(list, "field {}.{} = {} {}", message.name(), field.name(), field.number(), kind.trim_end())?;
            }
        }
        for numbers in &file.enum_type {
            for value in &numbers.value {
                writeln!(list, "value {}.{} = {}", numbers.name(), value.name(), value.number())?;
            }
        }
    }
    std::fs::write(Path::new(&std::env::var("OUT_DIR")?).join("wire.txt"), list)?;
    tonic_prost_build::configure().compile_fds(descriptors)?;
    println!("cargo::rerun-if-changed=proto/plat.proto");
    Ok(())
}
