use super::grgm900c::{COEFFICIENTS, RADIUS_M};
use super::*;
use crate::array::{Array, Ephemeris, ObservingWindows, segments_for};
use crate::units::MissionTime;
use crate::units::vector::sub;

/// Eight satellites, propagated for `days`.
fn propagated_config(days: f64) -> ArrayConfig {
    let propagate = PropagateConfig { days, ..PropagateConfig::default() };
    ArrayConfig { propagate, ..ArrayConfig::default() }
}

/// Potential of the field minus that of a point mass, m^2/s^2, at a position on axes that rotate with the Moon: fully
/// normalised Legendre functions by the recursion over degrees (Holmes and Featherstone 2002, Eq. 11 to 13), which
/// the forces do not use.
fn potential(degree: usize, r_m: Vec3) -> f64 {
    let radius_m = norm(r_m);
    let sine = r_m[2] / radius_m;
    let cosine = (r_m[0].hypot(r_m[1])) / radius_m;
    let longitude = r_m[1].atan2(r_m[0]);
    let mut sum = 0.0;
    for m in 0..=degree {
        let mut sectoral = 1.0;
        for k in 1..=m {
            let factor = if k == 1 { 3.0_f64.sqrt() } else { ((2 * k + 1) as f64 / (2 * k) as f64).sqrt() };
            sectoral *= factor * cosine;
        }
        let (mut before, mut now) = (0.0, sectoral);
        for n in m..=degree {
            if n > m {
                let (nf, mf) = (n as f64, m as f64);
                let a = ((2.0 * nf - 1.0) * (2.0 * nf + 1.0) / ((nf - mf) * (nf + mf))).sqrt();
                let b = ((2.0 * nf + 1.0) * (nf + mf - 1.0) * (nf - mf - 1.0)
                    / ((nf - mf) * (nf + mf) * (2.0 * nf - 3.0)))
                    .max(0.0)
                    .sqrt();
                (before, now) = (now, a * sine * now - b * before);
            }
            if n >= 2 {
                let [c, s] = COEFFICIENTS[(2..n).map(|k| k + 1).sum::<usize>() + m];
                let (sin, cos) = (m as f64 * longitude).sin_cos();
                sum += (RADIUS_M / radius_m).powi(n as i32) * now * (c * cos + s * sin);
            }
        }
    }
    GM_M3_S2 / radius_m * sum
}

#[test]
fn the_acceleration_is_the_gradient_of_the_potential() {
    let place = |lane: usize| -> Vec3 {
        let angle = 0.7 * lane as f64;
        [1.8e6 * angle.cos(), 1.7e6 * angle.sin(), 1.1e6 * (1.3 * angle).cos() - 0.3e6]
    };
    for degree in [0, 2, 3, 8, PropagateConfig::DEGREE_MAX] {
        let mut states = all_lanes(SatelliteState { position_m: [0.0; 3], velocity_m_s: [1.0, 2.0, 3.0] });
        for lane in 0..LANES {
            put(&mut states, lane, SatelliteState { position_m: place(lane), velocity_m_s: [1.0, 2.0, 3.0] });
        }
        // The prime meridian is at longitude 0.4, so that positions are rotated.
        let slopes = Forces::new(degree, false, 0.4).slopes(&[0.0; LANES], &states);
        for lane in 0..LANES {
            assert_eq!(of_lane(&slopes, lane).position_m, [1.0, 2.0, 3.0]);
            let radius_m = norm(place(lane));
            let middle = scale(-GM_M3_S2 / radius_m.powi(3), place(lane));
            let rest = sub(of_lane(&slopes, lane).velocity_m_s, middle);
            let at = |offset_m: Vec3| {
                potential(degree, rotated(add(place(lane), offset_m), [0.0, 0.0, 1.0], -0.4))
            };
            let slope: Vec3 = std::array::from_fn(|axis| {
                let mut offset_m = [0.0; 3];
                offset_m[axis] = 20.0;
                (at(offset_m) - at(scale(-1.0, offset_m))) / 40.0
            });
            // Differences err by (16 x 20 m / 1700 km)^2 / 6 of a slope of up to 1e-3 m/s^2, and by rounding of 1e3
            // m^2/s^2 over 40 m; the remainder after the point mass by rounding of 1.6 m/s^2.
            assert!(norm(sub(rest, slope)) < 2e-11, "{degree} {lane}: {rest:?} {slope:?}");
            assert!(degree == 0 || norm(rest) > 1e-5);
        }
    }
}

/// The table against GL0660B of another group (Konopliv et al. 2013, J. Geophys. Res. Planets 118, 1415), rounded to
/// five digits, and its unnormalised J2 and C22.
#[test]
fn the_table_agrees_with_another_field_of_the_moon() {
    let of = |n: usize, m: usize| COEFFICIENTS[(2..n).map(|k| k + 1).sum::<usize>() + m];
    for (n, m, c, s) in [
        (2, 0, -9.0880e-5, 0.0),
        (2, 2, 3.4674e-5, 0.0),
        (3, 0, -3.1973e-6, 0.0),
        (3, 1, 2.6368e-5, 5.4545e-6),
        (3, 2, 1.4171e-5, 4.8780e-6),
        (3, 3, 1.2275e-5, -1.7744e-6),
    ] {
        let [found_c, found_s] = of(n, m);
        // C20 differs by the permanent tide; the others in the fifth digit.
        let bound = if (n, m) == (2, 0) { 1e-8 } else { 2e-9 };
        assert!((found_c - c).abs() < bound && (found_s - s).abs() < bound, "{n} {m}: {found_c} {found_s}");
    }
    // Unnormalised: J2 = 2.033e-4 and C22 = 2.24e-5, as by the IAU and in most textbooks.
    assert!((-5_f64.sqrt() * of(2, 0)[0] - 2.033e-4).abs() < 2e-7);
    assert!(((5.0 / 12.0_f64).sqrt() * of(2, 2)[0] - 2.24e-5).abs() < 3e-8);
    assert_eq!(COEFFICIENTS.len(), (2..=PropagateConfig::DEGREE_MAX).map(|n| n + 1).sum::<usize>());
    // Zonal terms have no sine; the power decreases with the degree roughly by Kaula's rule for the Moon, 2.5e-4 /
    // n^2 (Lemoine et al., Fig. 2).
    for n in 2..=PropagateConfig::DEGREE_MAX {
        assert_eq!(of(n, 0)[1], 0.0);
        let power: f64 = (0..=n).flat_map(|m| of(n, m)).map(|value| value * value).sum();
        let rms = (power / (2 * n + 1) as f64).sqrt();
        let rule = 2.5e-4 / (n * n) as f64;
        assert!(rms < 3.0 * rule && rms > rule / 6.0, "{n}: {rms} {rule}");
    }
}

#[test]
fn without_a_field_orbits_are_ellipses() {
    let mut config = propagated_config(20.0);
    config.propagate.degree = 0;
    config.propagate.earth = false;
    for eccentricity in [0.0, 0.1] {
        config.eccentricity = eccentricity;
        let array = Array::new(&config).unwrap();
        let propagation = Propagation::new(&config).unwrap();
        let leader = KeplerOrbit::about(&propagation.leader(0.0, 0.0), GM_M3_S2);
        for t_s in [0.0, 100.0, 5e4, 20.0 * DAY_S - 77.0] {
            // There are 209 revolutions. Each closes to 1e-4 m at most, and a change of 1e-13 of the energy shifts
            // each later revolution by 3 pi 1e-13 of a turn times the radius.
            let error_m = norm(sub(array.position_m(0, t_s), leader.state(t_s).position_m));
            assert!(error_m < 0.02, "{eccentricity} {t_s}: {error_m}");
            // Followers are on the same track, each in its own plane.
            let arc_m = propagation.formation.as_ref().unwrap().arc_m(7, 0.0).0;
            let delay_s = arc_m / (GM_M3_S2 / leader.semi_major_axis_m()).sqrt();
            let behind_m = leader.state(t_s - delay_s).position_m;
            assert!(norm(sub(array.position_m(7, t_s), behind_m)) < 0.02, "{eccentricity} {t_s}");
        }
    }
}

/// Energy of each satellite in the frame that rotates with the Moon and the Earth (Jacobi's constant).
fn jacobi(array: &Array, n: usize, t_s: f64, degree: usize) -> f64 {
    let rate = TAU / SIDEREAL_MONTH_S;
    let SatelliteState { position_m, velocity_m_s } = array.state(n, t_s);
    let turning = rate * cross(position_m, velocity_m_s)[2];
    let own_m = rotated(position_m, [0.0, 0.0, 1.0], -rate * t_s);
    // GM and distance of the Earth, from textbooks.
    let (gm, distance_m) = (3.986_004_355e14, 3.844e8);
    let away_m = norm(sub([distance_m, 0.0, 0.0], own_m));
    let earth = gm * (1.0 / away_m - own_m[0] / (distance_m * distance_m));
    0.5 * dot(velocity_m_s, velocity_m_s)
        - turning
        - GM_M3_S2 / norm(own_m)
        - potential(degree, own_m)
        - earth
}

#[test]
fn jacobis_constant_is_conserved() {
    let array = Array::new(&propagated_config(30.0)).unwrap();
    for n in [0, 7] {
        let start = jacobi(&array, n, 0.0, 12);
        let mut terms = [f64::INFINITY, f64::NEG_INFINITY];
        for k in 1..=50 {
            // The times are nodes of the table, where nothing is interpolated.
            let t_s = f64::from(k) * 0.6 * DAY_S;
            let position_m = array.position_m(n, t_s);
            let own_m = rotated(position_m, [0.0, 0.0, 1.0], -TAU * t_s / SIDEREAL_MONTH_S);
            let disturbing = potential(12, own_m);
            terms = [terms[0].min(disturbing), terms[1].max(disturbing)];
            let change = jacobi(&array, n, t_s, 12) / start - 1.0;
            // Rounding of 22,000 steps of the method, 1e-16 each, and 1e-13 of each of its 314 revolutions.
            assert!(change.abs() < 1e-10, "{n} {k}: {change}");
        }
        // A field that is wrong by a thousandth would change it by more than that.
        assert!(terms[1] - terms[0] > 1e-4 * start.abs(), "{terms:?} {start}");
    }
}

#[test]
fn the_node_regresses_by_oblateness() {
    let mut config = propagated_config(27.321_661);
    config.propagate.degree = 2;
    config.propagate.earth = false;
    let array = Array::new(&config).unwrap();
    let node = |t_s: f64| {
        let normal = array.normal_hat(0, t_s);
        normal[0].atan2(-normal[1])
    };
    // Averages over an orbit, a month apart, so that the effect of C22 cancels.
    let mean = |from_s: f64| {
        (0..64).map(|k| node(from_s + array.orbital_period_s() * f64::from(k) / 64.0)).sum::<f64>() / 64.0
    };
    let span_s = 26.0 * DAY_S;
    let rate = (mean(span_s) - mean(0.0)) / span_s;
    let axis_m = 2_037_100.0_f64;
    let motion = (GM_M3_S2 / axis_m.powi(3)).sqrt();
    let expected = -1.5 * motion * 2.0323e-4 * (1.738e6 / axis_m).powi(2) * 30_f64.to_radians().cos();
    // First order in J2; the rest is of the order of C22, a tenth of J2, and of the remainder of a month.
    assert!((rate / expected - 1.0).abs() < 0.05, "{rate} {expected}");
}

#[test]
fn followers_follow_the_track_and_station_keeping_restores_them() {
    let mut config = propagated_config(8.0);
    config.cross_track_ratio = 0.02;
    let free = Array::new(&config).unwrap();
    config.propagate.keep_every_days = 2.0;
    let kept = Array::new(&config).unwrap();
    config.propagate.keep = StationKeeping::Orbit;
    let held = Array::new(&config).unwrap();
    let formation = Formation::new(&config).unwrap();
    let apart =
        |array: &Array, n: usize, t_s: f64| norm(sub(array.position_m(0, t_s), array.position_m(n, t_s)));
    for n in 1..8 {
        let arc_m = formation.arc_m(n, 0.0).0;
        // The distance is the chord of the arc; the field moves the leader off its ellipse by 1e-4 of an arc within a
        // minute.
        assert!((apart(&free, n, 0.0) / arc_m - 1.0).abs() < 2e-3, "{n}");
    }
    let reset = |array: &Array| -> Vec<f64> {
        // Satellite 8 jumps by kilometres, as the formation breathes by 100 km in a week.
        let jumps = (0..8 * 720).map(|k| f64::from(k) * STEP_S).filter(|t_s| {
            norm(sub(array.position_m(7, t_s + 1e-6), array.position_m(7, t_s - 1e-6))) > 100.0
        });
        jumps.collect()
    };
    assert_eq!(reset(&free), [0.0; 0]);
    for array in [&kept, &held] {
        let times = reset(array);
        assert_eq!(times.len(), 3, "{times:?}");
        for (k, t_s) in times.into_iter().enumerate() {
            // The jump is within an orbit after it was due.
            let late_s = t_s - 2.0 * DAY_S * (k + 1) as f64;
            assert!((0.0..8500.0).contains(&late_s), "{late_s}");
            for n in 1..8 {
                let expected = formation.arc_m(n, t_s).0;
                assert!((apart(array, n, t_s) / expected - 1.0).abs() < 0.02, "{n} {t_s}");
            }
            let sine = dot(array.position_m(0, t_s), array.earth_hat(t_s)) / norm(array.position_m(0, t_s));
            assert!(sine > 0.8, "{sine}");
        }
    }
    // Satellite 1 is on its circle again, and its plane has its inclination.
    let t_s = reset(&held)[2];
    assert!((norm(held.position_m(0, t_s)) - 2_037_100.0).abs() < 1e-3);
    assert!((held.normal_hat(0, t_s)[2].acos().to_degrees() - 30.0).abs() < 1e-9);
    assert!((norm(kept.position_m(0, t_s)) - 2_037_100.0).abs() > 100.0);
    // Its position is unchanged, except for its height and the tilt caused by the field in two days.
    let jump_m = norm(sub(held.position_m(0, t_s + 1e-6), held.position_m(0, t_s - 1e-6)));
    assert!(jump_m > 10.0 && jump_m < 20e3, "{jump_m}");
}

#[test]
fn packets_carry_propagated_orbits_to_less_than_a_centimetre() {
    let mut config = propagated_config(10.0);
    config.propagate.keep_every_days = 1.0;
    let array = Array::new(&config).unwrap();
    let mut worst_m: f64 = 0.0;
    let windows: Vec<_> = ObservingWindows::new(&array, 0.0, 10.0 * DAY_S).collect();
    assert!(windows.len() > 90);
    for window in windows {
        let mut table = Ephemeris::default();
        for segment in segments_for(&array, window.start, window.end, 60.0) {
            table.insert(segment);
        }
        let step = (window.end.0 - window.start.0) / 300;
        for k in 0..=300 {
            let t_s = MissionTime(window.start.0 + k * step).seconds();
            for n in [0, 7] {
                let found_m = table.position_at(t_s, n).unwrap();
                worst_m = worst_m.max(norm(sub(found_m, array.position_m(n, t_s))));
            }
        }
    }
    // A jump within a window would be kilometres.
    assert!(worst_m < 0.01, "{worst_m}");
}

#[test]
fn elements_are_propagated_and_impacts_are_reported() {
    let elements = |mean_anomaly_deg: f64, axis_m: f64| KeplerElements {
        semi_major_axis_m: axis_m,
        eccentricity: 0.1,
        inclination_deg: 60.0,
        node_longitude_deg: 10.0,
        periapsis_deg: 20.0,
        mean_anomaly_deg,
        node_rate_deg_per_day: 0.0,
        periapsis_rate_deg_per_day: 0.0,
    };
    let kepler: Vec<_> = (0..9).map(|n| elements(-0.01 * f64::from(n), 2.3e6)).collect();
    let config = ArrayConfig { satellites: 9, kepler, ..propagated_config(1.0) };
    let array = Array::new(&config).unwrap();
    assert_eq!((array.satellites(), array.known_s()), (9, Some([0.0, DAY_S])));
    for n in [0, 8] {
        let start = KeplerOrbit::about(&config.kepler[n], GM_M3_S2).state(0.0);
        assert_eq!(array.state(n, 0.0), start);
    }
    // The lowest point is 2 km above the surface: the field lowers it further within days.
    let low: Vec<_> = (0..3).map(|n| elements(-0.01 * f64::from(n), 1.9325e6)).collect();
    let said = Array::new(&ArrayConfig { satellites: 3, kepler: low, ..propagated_config(30.0) })
        .unwrap_err()
        .to_string();
    assert!(
        said.contains("array.propagate: satellite") && said.contains("km from the Moon's centre"),
        "{said}"
    );
    let kept = PropagateConfig { keep_every_days: 1.0, ..config.propagate.clone() };
    let wrong = ArrayConfig { propagate: kept, ..config };
    assert!(wrong.problems()[0].to_string().contains("array.propagate.keep_every_days = 1"));
    for (degree, days) in [(1, 1.0), (17, 1.0), (4, -1.0), (4, f64::NAN), (4, 5_001.0), (4, 1e9)] {
        let propagate = PropagateConfig { degree, days, ..PropagateConfig::default() };
        assert_eq!(
            ArrayConfig { propagate, ..ArrayConfig::default() }.problems().len(),
            1,
            "{degree} {days}"
        );
    }
}
