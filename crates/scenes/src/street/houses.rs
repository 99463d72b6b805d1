//! The houses of the street, from left to right as seen from the road.

use super::arcade::{Arcade, gatehouse};
use super::church::{nave, tower};
use super::house::{Bay, House, Storey};
use super::joinery::WindowStyle;
use super::layout::{END, FACADE, PAVEMENT};
use super::materials::Materials;
use super::roof::Roof;
use crate::assembly::{Assembly, Finish, place};
use Bay::{Balcony as Ba, Blind as Bl, Door as Do, Shop as Sh, ShopAwning as Aw, Window as Wi};
use diorama_geom::glam::{DAffine3, dvec3};
use std::f64::consts::PI;

/// A storey with rectangular windows.
fn storey(height: f64, bays: &[Bay], window: [f64; 2]) -> Storey {
    Storey { height, bays: bays.to_vec(), window, is_arched: false }
}

/// A storey with arched windows.
fn arched(height: f64, bays: &[Bay], window: [f64; 2]) -> Storey {
    Storey { is_arched: true, ..storey(height, bays, window) }
}

/// A house without ornament, to be changed.
fn house(m: &Materials, walls: Finish, width: f64, storeys: Vec<Storey>, seed: u64) -> House {
    let style = WindowStyle { wood: m.wood[0], trim: m.stone[1], shutters: None, surround: 0.17, bars: 2 };
    let roof = Roof::Saddle { tiles: m.roof, rise: 3.6, dormers: Vec::new(), dormer_style: style, chimneys: vec![1.2] };
    House { width, storeys, walls, base: walls, style, door: m.wood[3], roof, has_quoins: false, has_planters: false, seed }
}

/// A roof along the street.
fn saddle(house: &mut House, tiles: Finish, rise: f64, dormers: &[f64], chimneys: &[f64]) {
    house.roof = Roof::Saddle { tiles, rise, dormers: dormers.to_vec(), dormer_style: house.style, chimneys: chimneys.to_vec() };
}

/// Houses on the side of positive y.
fn north(m: &Materials) -> Vec<House> {
    let mut ocher = house(
        m,
        m.plaster[0],
        11.0,
        vec![
            storey(3.9, &[Aw(0), Do, Aw(0)], [1.1, 1.7]),
            storey(3.4, &[Wi, Wi, Wi, Wi], [1.0, 1.75]),
            storey(3.0, &[Wi, Wi, Wi, Wi], [1.0, 1.45]),
        ],
        11,
    );
    ocher.style.shutters = Some(m.wood[1]);
    ocher.door = m.wood[1];
    ocher.has_planters = true;
    saddle(&mut ocher, m.roof, 3.4, &[2.9, 8.1], &[5.4]);

    let mut brick = house(
        m,
        m.brick,
        9.0,
        vec![arched(3.8, &[Wi, Do, Wi], [1.15, 2.1]), arched(3.5, &[Wi, Wi, Wi], [1.15, 2.0]), arched(3.3, &[Wi, Wi, Wi], [1.15, 1.8])],
        12,
    );
    brick.style = WindowStyle { trim: m.stone[0], surround: 0.14, ..brick.style };
    brick.door = m.wood[2];
    brick.roof = Roof::Gable { tiles: m.roof, rise: 5.2, is_stepped: true, style: brick.style };

    let mut palace = house(
        m,
        m.blocks,
        14.0,
        vec![
            arched(4.6, &[Wi, Wi, Do, Wi, Wi], [1.2, 2.3]),
            storey(4.2, &[Wi, Ba, Ba, Ba, Wi], [1.15, 2.2]),
            storey(3.4, &[Wi, Wi, Wi, Wi, Wi], [1.15, 1.6]),
        ],
        13,
    );
    palace.style = WindowStyle { trim: m.stone[1], surround: 0.22, ..palace.style };
    saddle(&mut palace, m.slate, 2.6, &[], &[2.0, 12.0]);

    let mut rose = house(
        m,
        m.plaster[1],
        10.0,
        vec![
            storey(3.7, &[Sh, Do, Sh], [1.0, 1.6]),
            storey(3.2, &[Wi, Ba, Ba, Wi], [0.95, 1.65]),
            storey(3.1, &[Wi, Wi, Wi, Wi], [0.95, 1.6]),
            storey(2.8, &[Wi, Wi, Wi, Wi], [0.95, 1.3]),
        ],
        14,
    );
    rose.has_quoins = true;
    rose.door = m.wood[4];
    saddle(&mut rose, m.roof, 3.6, &[2.5, 5.0, 7.5], &[0.9]);

    let mut cream = house(
        m,
        m.plaster[2],
        16.0,
        vec![
            storey(4.0, &[Aw(1), Sh, Do, Aw(1), Aw(1)], [1.1, 1.8]),
            arched(3.6, &[Wi, Wi, Wi, Wi, Wi, Wi], [1.1, 2.0]),
            storey(3.1, &[Wi, Ba, Wi, Wi, Ba, Wi], [1.1, 1.5]),
        ],
        15,
    );
    cream.base = m.blocks;
    cream.style.trim = m.stone[0];
    cream.door = m.wood[2];
    cream.has_planters = true;
    saddle(&mut cream, m.roof, 3.8, &[4.0, 8.0, 12.0], &[2.0, 14.4]);
    vec![ocher, brick, palace, rose, cream]
}

/// Houses on the side of negative y besides the arcade and the church.
fn south(m: &Materials) -> [House; 2] {
    let mut sage = house(
        m,
        m.plaster[3],
        8.0,
        vec![
            storey(3.8, &[Sh, Do], [1.1, 1.8]),
            storey(3.3, &[Ba, Wi, Ba], [1.0, 1.75]),
            storey(3.1, &[Wi, Wi, Wi], [1.0, 1.6]),
            storey(2.9, &[Wi, Wi, Wi], [1.0, 1.35]),
        ],
        21,
    );
    sage.style.shutters = None;
    sage.door = m.wood[2];
    sage.has_planters = true;
    sage.roof = Roof::Gable { tiles: m.roof, rise: 3.6, is_stepped: false, style: sage.style };
    let mut brick = house(
        m,
        m.brick,
        9.5,
        vec![storey(3.8, &[Aw(0), Do, Wi], [1.2, 1.8]), storey(3.4, &[Wi, Wi, Wi], [1.2, 1.8]), storey(3.2, &[Wi, Wi, Wi], [1.2, 1.6])],
        22,
    );
    brick.base = m.plaster[2];
    brick.door = m.wood[1];
    saddle(&mut brick, m.slate, 3.2, &[3.0, 6.5], &[8.4]);
    [sage, brick]
}

/// Houses at the ends of the street and beyond, with their places.
fn ends(m: &Materials) -> Vec<(House, DAffine3)> {
    let narrow = |walls: Finish, width: f64, seed: u64| {
        let mut h = house(
            m,
            walls,
            width,
            vec![storey(3.7, &[Do, Wi], [1.1, 1.7]), storey(3.3, &[Wi, Wi], [1.1, 1.7]), storey(3.0, &[Wi, Wi], [1.1, 1.4])],
            seed,
        );
        h.style.shutters = Some(m.wood[if seed.is_multiple_of(2) { 4 } else { 3 }]);
        h
    };
    let west = |y: f64, x: f64| place(dvec3(x, y, PAVEMENT), 0.5 * PI);
    let east = |y: f64, x: f64| place(dvec3(x, y, PAVEMENT), -0.5 * PI);
    let far = |walls: Finish, seed: u64| {
        let bays = [Wi, Wi, Wi, Do, Wi, Wi, Wi];
        let plain = [Wi, Wi, Wi, Bl, Wi, Wi, Wi];
        house(m, walls, 20.0, vec![storey(3.9, &bays, [1.1, 1.7]), storey(3.4, &plain, [1.1, 1.7]), storey(3.0, &plain, [1.1, 1.4])], seed)
    };
    let mut tall = narrow(m.plaster[5], 6.5, 31);
    tall.storeys.insert(2, storey(3.2, &[Ba, Wi], [1.05, 1.7]));
    vec![
        (tall, west(-FACADE, -END)),
        (narrow(m.plaster[4], 6.5, 32), west(FACADE - 6.5, -END)),
        (far(m.plaster[1], 33), west(-10.0, -END - 22.0)),
        (narrow(m.plaster[4], 5.5, 34), east(FACADE, END)),
        (narrow(m.plaster[0], 5.5, 35), east(-FACADE + 5.5, END)),
        (far(m.plaster[2], 36), east(10.0, END + 28.0)),
    ]
}

/// All houses with names and places.
pub fn houses(m: &Materials) -> Vec<(String, Assembly, DAffine3)> {
    let mut out: Vec<(String, Assembly, DAffine3)> = Vec::new();
    let mut add = |object: Assembly, at: DAffine3| out.push((format!("house.{}", out.len() + 1), object, at));
    let mut x = -END;
    for h in north(m) {
        add(h.build(m), place(dvec3(x, FACADE, PAVEMENT), 0.0));
        x += h.width;
    }
    // Seen from the road, the left end of the southern row is at +x.
    let south_at = |x: f64| place(dvec3(x, -FACADE, PAVEMENT), PI);
    let [sage, brick] = south(m);
    add(brick.build(m), south_at(END));
    add(sage.build(m), south_at(2.0));
    for (h, at) in ends(m) {
        add(h.build(m), at);
    }
    let style = WindowStyle { wood: m.wood[0], trim: m.stone[0], shutters: None, surround: 0.18, bars: 3 };
    let roof =
        Roof::Saddle { tiles: m.roof, rise: 3.6, dormers: vec![4.4, 9.0, 15.0, 19.6], dormer_style: style, chimneys: vec![1.5, 22.0] };
    let arcade = Arcade { width: 24.0, bays: 7, walls: m.plaster[5], style, roof };
    out.push(("arcade".into(), arcade.build(m), south_at(-6.0)));
    out.push(("church.tower".into(), tower(m, 6.5, &style), south_at(20.5)));
    out.push(("church.nave".into(), nave(m, 12.0, &style), south_at(14.0)));
    let top = Roof::Saddle { tiles: m.roof, rise: 3.0, dormers: vec![5.5], dormer_style: style, chimneys: Vec::new() };
    out.push(("gate".into(), gatehouse(m, 11.0, &style, &top), place(dvec3(END, 5.5, PAVEMENT), -0.5 * PI)));
    out
}
