use super::*;
use diorama_testkit::assert_close;

#[test]
fn matches_the_reference() {
    for c in cases::cases() {
        let mut map = ErrorMap::new(cases::SIZES.len());
        assert_close("sums of equal errors", map.cdf(), &reference::cdf(&map.drawn), 1e-6);
        let want = reference::record(&map.errors, &c.hits());
        c.hits().iter().for_each(|h| map.record(h.image, h.u, h.v, h.error));
        assert_close("errors", &map.errors, &want, 1e-5);
        assert!(map.drawn.iter().all(|e| *e == 1.0), "draws go by the errors of the last refresh");
        map.refresh();
        assert_close("sums", map.cdf(), &reference::cdf(&map.errors), 1e-6);
    }
}

#[test]
fn mean_errors_of_a_cell_are_mixed_like_rays_of_that_error() {
    let c = &cases::cases()[2];
    let mut hits = c.hits();
    hits.iter_mut().for_each(|h| h.error = 0.3);
    let errors = vec![1.0; 2 * CELLS * CELLS];
    let one_by_one: Vec<f32> = reference::record(&errors, &hits).iter().map(|e| *e as f32).collect();
    assert_close("means", &one_by_one, &reference::record_means(&errors, &hits), 1e-6);
}

#[test]
fn cells_are_drawn_in_proportion_to_the_roots_of_their_errors() {
    let mut map = ErrorMap::new(1);
    map.errors.fill(0.0);
    (map.errors[3], map.errors[200]) = (1.0, 9.0);
    map.refresh();
    let of = |cell: usize| (0..1000).filter(|i| map.cell((*i as f32 + 0.5) / 1000.0) == cell).count();
    assert_eq!((of(3), of(200)), (250, 750));
}
