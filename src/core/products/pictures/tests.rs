use super::*;
use crate::sky::healpix::{pixel_count, pixel_directions};

fn colour_at(picture: &Picture, x: f64, y: f64) -> [u8; 3] {
    let start = 3 * (y as usize * picture.width() + x as usize);
    [picture.rgb()[start], picture.rgb()[start + 1], picture.rgb()[start + 2]]
}

fn bare() -> Sheet {
    Sheet {
        view: View { frame: String::new(), graticule: false, ..View::default() },
        width_px: 800,
        ..Sheet::default()
    }
}

fn panel(values: &[f64], scale: ColourScale) -> MapPanel<'_> {
    MapPanel { values, caption: String::new(), scale, unit: "K".to_owned() }
}

#[test]
fn longitude_grows_to_the_left_and_latitude_upwards() {
    for (axis, bright, dark) in [(1, (0.3, 0.5), (0.7, 0.5)), (2, (0.5, 0.3), (0.5, 0.7))] {
        let values: Vec<f64> = pixel_directions(16).iter().map(|d| d[axis]).collect();
        let scale = ColourScale::new(-1.0, 1.0, Scaling::Linear, Palette::Inferno).unwrap();
        let picture = draw_sheet(&[panel(&values, scale)], &bare()).unwrap();
        // The map fills the width of the page except for the margins, and is nearly centred.
        let map_height = 0.445 * 800.0;
        let sum = |(x, y): (f64, f64)| {
            let c = colour_at(&picture, x * 800.0, 15.0 + y * map_height);
            c.into_iter().map(u32::from).sum::<u32>()
        };
        assert!(sum(bright) > sum(dark) + 100, "axis {axis}");
    }
}

#[test]
fn a_rotation_turns_the_view() {
    let values: Vec<f64> = pixel_directions(16).iter().map(|d| d[0]).collect();
    let scale = ColourScale::new(-1.0, 1.0, Scaling::Linear, Palette::Inferno).unwrap();
    // The frame drawn has its pole where the map has its x axis.
    let turned = View { rotation: [[0., 0., 1.], [1., 0., 0.], [0., 1., 0.]], ..bare().view };
    let picture = draw_sheet(&[panel(&values, scale)], &Sheet { view: turned, ..bare() }).unwrap();
    let north = colour_at(&picture, 400.0, 40.0);
    let south = colour_at(&picture, 400.0, 345.0);
    assert!(north.map(u32::from).iter().sum::<u32>() > south.map(u32::from).iter().sum::<u32>() + 300);
}

#[test]
fn unseen_pixels_are_grey() {
    let scale = ColourScale::new(0.0, 1.0, Scaling::Linear, Palette::Inferno).unwrap();
    for value in [f64::NAN, -1.6375e30, f64::from(-1.6375e30_f32), f64::INFINITY] {
        let values = vec![value; pixel_count(2)];
        for sampling in [Sampling::Pixels, Sampling::Interpolated] {
            let sheet = Sheet { view: View { sampling, ..bare().view }, ..bare() };
            let picture = draw_sheet(&[panel(&values, scale)], &sheet).unwrap();
            assert_eq!(colour_at(&picture, 400.0, 200.0), [160; 3]);
        }
    }
}

#[test]
fn negative_values_are_not_painted_as_cold() {
    let scale = ColourScale::new(1.0, 10.0, Scaling::Log, Palette::Inferno).unwrap();
    for (value, is_marked) in [(-3.0, true), (0.0, true), (0.1, false), (1e9, false)] {
        let values = vec![value; pixel_count(2)];
        let picture = draw_sheet(&[panel(&values, scale)], &bare()).unwrap();
        // Inferno goes from black to light yellow, with little blue at both ends.
        let [red, _, blue] = colour_at(&picture, 400.0, 200.0);
        assert_eq!(blue > 200 && red < 100, is_marked, "{value}");
    }
}

#[test]
fn a_view_in_another_frame_shows_the_galaxy_where_it_is() {
    // Bright around the Galactic centre, which ecliptic maps have at longitude 266.84, latitude -5.54 degrees.
    let (l, b) = (266.84_f64.to_radians(), -5.54_f64.to_radians());
    let centre = [l.cos() * b.cos(), l.sin() * b.cos(), b.sin()];
    let near = |n: &[f64; 3]| n.iter().zip(centre).map(|(a, b)| a * b).sum::<f64>();
    let values: Vec<f64> = pixel_directions(32).iter().map(near).collect();
    let scale = ColourScale::new(-1.0, 1.0, Scaling::Linear, Palette::Inferno).unwrap();
    let galactic =
        View { graticule: false, ..View::of(crate::sky::Frame::Galactic, crate::sky::Frame::Ecliptic) };
    let sheet = Sheet { view: View { frame: String::new(), ..galactic }, ..bare() };
    let picture = draw_sheet(&[panel(&values, scale)], &sheet).unwrap();
    let brightness = |x: f64, y: f64| colour_at(&picture, x, y).into_iter().map(u32::from).sum::<u32>();
    // The brightest position is the centre of the picture.
    let middle = brightness(400.0, 193.0);
    for (x, y) in [(330.0, 193.0), (470.0, 193.0), (400.0, 150.0), (400.0, 236.0)] {
        assert!(middle > brightness(x, y), "{x} {y}");
    }
}

#[test]
fn scales_suit_their_values() {
    let ramp: Vec<f64> = (0..=1000).map(f64::from).collect();
    let scale = ColourScale::robust(&ramp, Scaling::Linear, Palette::Inferno);
    assert_eq!((scale.low(), scale.high()), (5.0, 995.0));
    let outlier: Vec<f64> = ramp.iter().copied().chain([f64::NAN, -1.6375e30]).collect();
    assert_eq!(ColourScale::robust(&outlier, Scaling::Linear, Palette::Inferno), scale);
    let errors = ColourScale::symmetric(&[-3.0, 1.0, 2.0, f64::NAN]);
    assert!(errors.low() == -errors.high() && errors.high() > 2.9);
    for hostile in [&[][..], &[0.0; 3], &[f64::NAN], &[-5.0, -5.0], &[1e308, -1e308, 5e-324]] {
        for scaling in [Scaling::Linear, Scaling::Log] {
            let scale = ColourScale::robust(hostile, scaling, Palette::Inferno);
            let valid = ColourScale::new(scale.low(), scale.high(), scaling, Palette::Inferno);
            assert!(valid.is_ok(), "{hostile:?} {scaling:?} {scale:?}");
        }
        let scale = ColourScale::symmetric(hostile);
        assert!(scale.low() < scale.high());
    }
    for (low, high, scaling) in [
        (1.0, 1.0, Scaling::Linear),
        (f64::NAN, 1.0, Scaling::Linear),
        (0.0, 1.0, Scaling::Log),
        (-1.0, f64::INFINITY, Scaling::Linear),
    ] {
        assert!(matches!(
            ColourScale::new(low, high, scaling, Palette::Inferno),
            Err(PictureError::Limits { .. })
        ));
    }
}

#[test]
fn invalid_pages_are_refused() {
    let scale = ColourScale::new(0.0, 1.0, Scaling::Linear, Palette::Inferno).unwrap();
    let values = vec![0.5; 13];
    assert!(matches!(
        draw_sheet(&[panel(&values, scale)], &bare()),
        Err(PictureError::PixelCount { panel: 0, pixels: 13 })
    ));
    assert!(matches!(draw_sheet(&[], &bare()), Err(PictureError::Size { .. })));
    let values = vec![0.5; 12];
    for width_px in [0, 15, 20_000, usize::MAX] {
        let sheet = Sheet { width_px, ..bare() };
        assert!(matches!(draw_sheet(&[panel(&values, scale)], &sheet), Err(PictureError::Size { .. })));
    }
    assert!(matches!(draw_plots("", &[], 1), Err(PictureError::Size { .. })));
}

#[test]
fn plots_of_anything_are_drawn() {
    let bad = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 0.0, -1.0, 1e308, -1e308, 5e-324, 1.0];
    let points: Vec<(f64, f64)> = bad.iter().flat_map(|&x| bad.iter().map(move |&y| (x, y))).collect();
    for log in [false, true] {
        for limits in [None, Some((f64::NAN, 1.0)), Some((1.0, 0.0)), Some((0.0, 1e-320))] {
            let axis = Axis { label: "x".to_owned(), log, limits };
            let curve = Curve { label: "all".to_owned(), points: points.clone(), dashed: log };
            let plot = Plot {
                x: axis.clone(),
                y: axis,
                curves: vec![curve],
                levels: bad.to_vec(),
                ..Plot::default()
            };
            assert!(draw_plots("t", &[plot], 1).is_ok());
        }
    }
    assert!(draw_plots("", &[Plot::default()], 5).is_ok());
}

#[test]
fn files_hold_the_picture_and_its_texts_and_appear_whole() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("map.png");
    let values: Vec<f64> = pixel_directions(4).iter().map(|d| d[0]).collect();
    let map = panel(&values, ColourScale::symmetric(&values));
    let picture =
        draw_map(&MapPanel { caption: "δT at 10 MHz".to_owned(), ..map }, "a line", &View::default())
            .unwrap();
    picture.write(&path).unwrap();
    picture.write(&path).unwrap();
    let names: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(names, ["map.png"]);

    let file = std::io::BufReader::new(std::fs::File::open(&path).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut pixels).unwrap();
    assert_eq!(pixels, picture.rgb());
    let texts: Vec<(String, String)> = reader
        .info()
        .utf8_text
        .iter()
        .map(|chunk| (chunk.keyword.clone(), chunk.get_text().unwrap()))
        .collect();
    let pair = |a: &str, b: &str| (a.to_owned(), b.to_owned());
    assert!(texts.contains(&pair("Title", "δT at 10 MHz")));
    assert!(texts.iter().any(|(k, v)| k == "Software" && v.starts_with("lunarray ")));

    // Folders are made; a file in the way of one is an error.
    let nowhere = path.join("below").join("map.png");
    assert!(matches!(picture.write(&nowhere), Err(PictureError::Write { path, .. }) if path == nowhere));
}
