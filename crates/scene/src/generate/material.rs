//! The plain materials of generated scenes.

/// A material: opaque, without textures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[allow(missing_docs)]
pub(super) enum Material {
    RedBrick,
    BrownBrick,
    Sandstone,
    Limestone,
    Concrete,
    Plaster,
    Ochre,
    DarkPanel,
    Trim,
    Frame,
    Glass,
    BlueGlass,
    Door,
    Roof,
    Metal,
    DarkMetal,
    Wood,
    Timber,
    Tile,
    Slate,
    Rubble,
    Asphalt,
    Pavement,
    Paint,
    Yard,
    Cobble,
    Meadow,
    Bark,
    Leaf,
    DarkLeaf,
    PaleLeaf,
    Blade,
    DryBlade,
    Stem,
    RedPetal,
    YellowPetal,
    WhitePetal,
    BluePetal,
    Lamp,
    Rubber,
    RedCar,
    WhiteCar,
    BlackCar,
    SilverCar,
    BlueCar,
    YellowCar,
}

/// Looks of a material.
pub(super) struct Look {
    pub(super) name: &'static str,
    /// Linear RGB.
    pub(super) color: [f64; 3],
    pub(super) metallic: f64,
    pub(super) roughness: f64,
    /// True for leaves and blades, which are single sheets.
    pub(super) double_sided: bool,
}

impl Material {
    /// How the material looks.
    pub(super) fn look(self) -> Look {
        use Material as M;
        let solid = |name, color, metallic, roughness| Look {
            name,
            color,
            metallic,
            roughness,
            double_sided: false,
        };
        let wall = |name, color| solid(name, color, 0.0, 0.9);
        let car = |name, color| solid(name, color, 0.3, 0.35);
        let sheet =
            |name, color| Look { name, color, metallic: 0.0, roughness: 0.8, double_sided: true };
        match self {
            M::RedBrick => wall("red brick", [0.36, 0.11, 0.07]),
            M::BrownBrick => wall("brown brick", [0.24, 0.13, 0.08]),
            M::Sandstone => wall("sandstone", [0.55, 0.43, 0.28]),
            M::Limestone => wall("limestone", [0.62, 0.58, 0.48]),
            M::Concrete => wall("concrete", [0.42, 0.42, 0.40]),
            M::Plaster => wall("plaster", [0.78, 0.74, 0.66]),
            M::Ochre => wall("ochre plaster", [0.66, 0.46, 0.22]),
            M::DarkPanel => solid("dark panel", [0.08, 0.09, 0.10], 0.2, 0.5),
            M::Trim => wall("trim", [0.68, 0.65, 0.58]),
            M::Frame => solid("window frame", [0.75, 0.75, 0.72], 0.0, 0.5),
            M::Glass => solid("glass", [0.03, 0.05, 0.07], 0.0, 0.08),
            M::BlueGlass => solid("blue glass", [0.05, 0.13, 0.20], 0.1, 0.08),
            M::Door => solid("door", [0.16, 0.07, 0.03], 0.0, 0.6),
            M::Roof => wall("roof", [0.17, 0.17, 0.17]),
            M::Metal => solid("metal", [0.50, 0.51, 0.52], 0.8, 0.4),
            M::DarkMetal => solid("dark metal", [0.06, 0.07, 0.07], 0.6, 0.5),
            M::Wood => wall("wood", [0.30, 0.17, 0.08]),
            M::Timber => wall("timber", [0.10, 0.055, 0.03]),
            M::Tile => wall("roof tile", [0.42, 0.13, 0.07]),
            M::Slate => wall("slate", [0.13, 0.15, 0.18]),
            M::Rubble => wall("rubble", [0.38, 0.36, 0.32]),
            M::Asphalt => wall("asphalt", [0.075, 0.075, 0.08]),
            M::Pavement => wall("pavement", [0.36, 0.35, 0.34]),
            M::Paint => wall("road paint", [0.80, 0.78, 0.60]),
            M::Yard => wall("yard", [0.20, 0.24, 0.14]),
            M::Cobble => wall("cobble", [0.27, 0.25, 0.22]),
            M::Meadow => wall("meadow", [0.11, 0.19, 0.05]),
            M::Bark => wall("bark", [0.14, 0.09, 0.06]),
            M::Leaf => sheet("leaf", [0.08, 0.22, 0.04]),
            M::DarkLeaf => sheet("dark leaf", [0.04, 0.14, 0.04]),
            M::PaleLeaf => sheet("pale leaf", [0.16, 0.28, 0.06]),
            M::Blade => sheet("grass blade", [0.12, 0.27, 0.05]),
            M::DryBlade => sheet("dry grass blade", [0.33, 0.32, 0.12]),
            M::Stem => sheet("stem", [0.10, 0.22, 0.06]),
            M::RedPetal => sheet("red petal", [0.70, 0.04, 0.03]),
            M::YellowPetal => sheet("yellow petal", [0.85, 0.62, 0.04]),
            M::WhitePetal => sheet("white petal", [0.85, 0.85, 0.82]),
            M::BluePetal => sheet("blue petal", [0.16, 0.14, 0.65]),
            M::Lamp => wall("lamp", [0.90, 0.86, 0.70]),
            M::Rubber => wall("rubber", [0.02, 0.02, 0.02]),
            M::RedCar => car("red car", [0.45, 0.02, 0.02]),
            M::WhiteCar => car("white car", [0.75, 0.75, 0.75]),
            M::BlackCar => car("black car", [0.02, 0.02, 0.025]),
            M::SilverCar => car("silver car", [0.45, 0.46, 0.48]),
            M::BlueCar => car("blue car", [0.03, 0.08, 0.30]),
            M::YellowCar => car("yellow car", [0.75, 0.45, 0.02]),
        }
    }
}
