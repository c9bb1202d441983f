//! Tests of sums in parts (on ranks or on disk), and of products of several vectors.

use super::*;
use crate::ranks::on_threads;

/// Accumulates sums in parts, and returns the complete sums.
fn in_parts(
    count: usize,
    blocks: impl Fn(usize) -> Vec<PlacedVisibilities>,
) -> Result<HarmonicSums, AccumulationError> {
    let folder = tempfile::tempdir().unwrap();
    let mut part = SumPart::first(count, folder.path());
    for number in 0.. {
        let mut engine = HarmonicEngine::new(setup()).unwrap().with_ranks(&part.ranks());
        for block in blocks(number) {
            let _ = engine.add(&block).unwrap();
        }
        if let Some(sums) = engine.finish_part(&part)? {
            // No file remains, even if the process is killed.
            assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 0);
            return Ok(sums);
        }
        part = part.next().unwrap();
    }
    unreachable!()
}

#[test]
fn sums_on_disk_have_the_bits_of_those_in_memory() {
    let blocks = blocks(0, 6);
    let whole = engine(&blocks).into_sums();
    let bits = |values: &[f64]| values.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    let all = |sums: &HarmonicSums| {
        let (x, mut y) = (vector(8), vec![0.0; sums.unknowns()]);
        sums.apply(&x, &mut y);
        let mut order = vector(9);
        sums.order_blocks().multiply(&mut order);
        [bits(&y), bits(sums.right_hand_side()), bits(sums.noise_right_hand_side()), bits(&order)]
    };
    for count in [1, 2, 3, 7, 1000] {
        let sums = in_parts(count, |_| blocks.clone()).unwrap();
        assert!(all(&sums) == all(&whole) && sums.counts() == whole.counts(), "{count} parts");
        assert_eq!(sums.matrix_product_flops(), whole.matrix_product_flops());
        assert!(sums.failure().is_none());
    }
    let folder = tempfile::tempdir().unwrap();
    let moved = engine(&blocks).into_sums().on_disk(folder.path()).unwrap();
    assert!(moved.tori.nodes.is_empty() && all(&moved) == all(&whole));
    assert_eq!(moved.matrix_product_flops(), whole.matrix_product_flops());
    // One of the readings has other data.
    let other = in_parts(3, |number| blocks[..blocks.len() - usize::from(number == 1)].to_vec());
    assert!(matches!(other, Err(AccumulationError::Mismatch { .. })));
    // A disk that loses data.
    let mut sums = in_parts(2, |_| blocks.clone()).unwrap();
    sums.tori.stored.as_ref().unwrap().truncate(1000);
    let mut y = vec![0.0; sums.unknowns()];
    sums.apply(&vector(8), &mut y);
    assert!(y.iter().all(|y| y.is_nan()));
    assert!(sums.failure().unwrap().contains("expected to read what was written"), "{:?}", sums.failure());
    sums.right = OnceLock::new();
    assert!(sums.right_hand_side().iter().all(|y| y.is_nan()));
}

#[test]
fn shared_products_have_the_bits_of_single_ones() {
    let blocks = blocks(0, 6);
    let vectors = [vector(8), vec![0.0; (L_MAX + 1) * (L_MAX + 1)], vector(9), vector(10)];
    let bits = |product: &[f64]| product.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
    let whole = engine(&blocks).into_sums();
    let alone = vectors.each_ref().map(|x| {
        let mut product = vec![0.0; x.len()];
        whole.apply(x, &mut product);
        bits(&product)
    });
    // Sums on disk are read in alternating order.
    let stored = in_parts(3, |_| blocks.clone()).unwrap();
    assert_eq!([(); 4].map(|()| stored.tori.next_is_reversed()), [false, true, false, true]);
    assert!(!whole.tori.next_is_reversed() && !whole.tori.next_is_reversed());
    for sums in [&whole, &stored] {
        for count in [4, 3, 2, 1, 0] {
            let x: Vec<&[f64]> = vectors[..count].iter().map(Vec::as_slice).collect();
            let products = sums.apply_all(&x);
            assert!(
                products.iter().map(|product| bits(product)).eq(alone[..count].iter().cloned()),
                "{count}"
            );
        }
    }
}

/// The bits of all results that a solver needs.
fn answers(sums: &HarmonicSums) -> Vec<u64> {
    let mut product = vec![0.0; sums.unknowns()];
    sums.apply(&vector(3), &mut product);
    let blocks = sums.order_blocks();
    let diagonal = (0..=L_MAX).map(|l| blocks.diagonal(l));
    let right = [sums.right_hand_side(), sums.noise_right_hand_side()].concat();
    product.into_iter().chain(right).chain(diagonal).map(f64::to_bits).collect()
}

/// The number of non-zero weights of all nodes.
fn weight_count(sums: &HarmonicSums) -> usize {
    sums.tori.nodes.iter().flatten().flat_map(|node| &node.weights).filter(|w| **w != 0.0).count()
}

#[test]
fn results_do_not_depend_on_the_number_of_ranks() {
    let blocks = blocks(0, 12);
    // Also with so few data that some blocks and nodes are empty, and with none.
    for blocks in [&blocks[..], &blocks[..1], &[]] {
        let alone = engine(blocks).into_sums();
        let (expected, expected_weights) = (answers(&alone), weight_count(&alone));
        // 112 alphas in seven blocks, and 56 of data in four.
        for count in [1, 2, 3, 4, 9] {
            let found = on_threads(count, |ranks| {
                let mut engine = HarmonicEngine::new(setup()).unwrap().with_ranks(ranks);
                for block in blocks {
                    assert_eq!(engine.add(block).unwrap().visibilities, block.len() as u64);
                }
                // A snapshot gives the same results.
                assert!(answers(&engine.sums()) == expected);
                let sums = engine.into_sums();
                (answers(&sums) == expected, weight_count(&sums), sums.counts() == alone.counts())
            });
            assert!(found.iter().all(|(is_equal, _, counts)| *is_equal && *counts), "{count} ranks");
            assert_eq!(found.iter().map(|(_, weights, _)| weights).sum::<usize>(), expected_weights);
        }
    }
}

#[test]
fn any_number_of_ranks_resumes_from_the_shares_of_others() {
    let blocks = blocks(0, 12);
    let (before, after) = blocks.split_at(blocks.len() / 2);
    let mut whole = Vec::new();
    engine(before).checkpoint(&mut whole).unwrap();
    let expected = answers(&engine(&blocks).into_sums());
    let share = |rank, count| RankShare { rank, count };
    for written in [1, 2, 3, 9] {
        let parts: Vec<Vec<u8>> = on_threads(written, |ranks| {
            let mut engine = HarmonicEngine::new(setup()).unwrap().with_ranks(ranks);
            before.iter().for_each(|block| drop(engine.add(block).unwrap()));
            let mut part = Vec::new();
            engine.checkpoint(&mut part).unwrap();
            part
        });
        let joined = |ranks: &Ranks| {
            let read = |(rank, part): (usize, &Vec<u8>)| {
                HarmonicEngine::restore_part(&mut &part[..], share(rank, written), ranks).unwrap()
            };
            let mut engines = parts.iter().enumerate().map(read);
            let mut first = engines.next().unwrap();
            engines.for_each(|other| first.join(other).unwrap());
            first
        };
        // The checkpoint of a single process is the one that it would have written itself.
        let mut again = Vec::new();
        joined(&Ranks::single()).checkpoint(&mut again).unwrap();
        assert!(again == whole, "{written} parts");
        for count in [2, 3] {
            let found = on_threads(count, |ranks| {
                let mut engine = joined(ranks);
                after.iter().for_each(|block| drop(engine.add(block).unwrap()));
                answers(&engine.into_sums()) == expected
            });
            assert!(found.iter().all(|is_equal| *is_equal), "{written} parts, {count} ranks");
        }
    }
}

#[test]
fn shares_that_do_not_match_are_refused() {
    let blocks = blocks(0, 4);
    let parts: Vec<Vec<u8>> = on_threads(2, |ranks| {
        let mut engine = HarmonicEngine::new(setup()).unwrap().with_ranks(ranks);
        blocks.iter().for_each(|block| drop(engine.add(block).unwrap()));
        let mut part = Vec::new();
        engine.checkpoint(&mut part).unwrap();
        part
    });
    let read = |at: usize, rank| {
        HarmonicEngine::restore_part(&mut &parts[at][..], RankShare { rank, count: 2 }, &Ranks::single())
    };
    // A share that is read as the other one.
    assert!(read(0, 1).unwrap_err().to_string().contains("the rank's own blocks"));
    // The same share twice, and a share of other data.
    let same = read(0, 0).unwrap().join(read(0, 0).unwrap()).unwrap_err();
    assert!(same.to_string().contains("the same alphas"), "{same}");
    let other = read(0, 0).unwrap().join(engine(&blocks[..1])).unwrap_err();
    assert!(matches!(other, AccumulationError::Mismatch { .. }), "{other}");
}
