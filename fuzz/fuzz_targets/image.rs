//! Photos and masks: JPEG, PNG, WebP, TIFF, as ingest decodes them.
#![no_main]

use std::io::Cursor;

use libfuzzer_sys::fuzz_target;

#[allow(dead_code, reason = "ingest uses more of it")]
#[path = "../../dataset/src/photo.rs"]
mod photo;

fuzz_target!(|bytes: &[u8]| {
    // What a capture that says no size believes, and then what one says that does.
    let Ok((width, height)) = photo::size(Cursor::new(bytes)) else { return };
    let area = width as usize * height as usize;
    if let Ok(pixels) = photo::decode(bytes, width, height) {
        assert_eq!(pixels.rgb.len(), 3 * area);
        assert!(pixels.mask.is_none_or(|mask| mask.len() == area && mask.contains(&0)));
        // Ingest decodes the mask of a photo that was read, of that photo's size.
        assert!(photo::decode_mask(bytes, width, height).is_ok_and(|mask| mask.len() == area));
    }
    assert!(photo::decode(bytes, width.wrapping_add(1), height).is_err(), "of another size than its camera's");
});
