//! The scans of an E57 file, one after the other, as points in the frame of the file. The crate `e57` reads header and XML; the packets
//! of points are decoded here, column by column and in bounded memory (its own iterator allocates for each point, and without limit
//! where the streams of a damaged file are of unequal length). source: ASTM E2807-11.
use crate::file_at::FileAt;
use crate::pages::{Pages, PAGE_BYTES};
use e57::{E57Reader, PointCloud, RecordDataType, RecordName, RecordValue};

/// In the order of chiaro::stream::ScalarType.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    F32 = 8,
    F64 = 9,
}

impl Scalar {
    fn bytes(self) -> usize {
        match self {
            Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::I64 | Scalar::F64 => 8,
        }
    }
}

/// What values an attribute has over all scans.
#[derive(Clone, Copy, Debug)]
enum Kind {
    Single,
    Double,
    Whole { min: i64, max: i64 },
}

impl Kind {
    fn of(data: &RecordDataType) -> Self {
        match data {
            RecordDataType::Single { .. } => Kind::Single,
            RecordDataType::Double { .. } | RecordDataType::ScaledInteger { .. } => Kind::Double,
            RecordDataType::Integer { min, max } => Kind::Whole { min: *min, max: *max },
        }
    }

    fn join(self, other: Self) -> Self {
        match (self, other) {
            (Kind::Single, Kind::Single) => Kind::Single,
            (Kind::Whole { min: a, max: b }, Kind::Whole { min: c, max: d }) => Kind::Whole { min: a.min(c), max: b.max(d) },
            _ => Kind::Double,
        }
    }

    fn scalar(self) -> Scalar {
        match self {
            Kind::Single => Scalar::F32,
            Kind::Double => Scalar::F64,
            Kind::Whole { min, max } => {
                let fits = |low: i64, high: i64| min >= low && max <= high;
                if fits(0, 0xff) {
                    Scalar::U8
                } else if fits(0, 0xffff) {
                    Scalar::U16
                } else if fits(0, 0xffff_ffff) {
                    Scalar::U32
                } else if fits(-0x80, 0x7f) {
                    Scalar::I8
                } else if fits(-0x8000, 0x7fff) {
                    Scalar::I16
                } else if fits(-0x8000_0000, 0x7fff_ffff) {
                    Scalar::I32
                } else {
                    Scalar::I64
                }
            }
        }
    }
}

pub struct Property {
    pub name: String,
    pub scalar: Scalar,
    kind: Kind,
}

/// How a column of the packets becomes numbers.
#[derive(Clone, Copy)]
enum Coding {
    Single,
    Double,
    Whole { min: i64 },
    Scaled { min: i64, scale: f64, offset: f64 },
}

/// One byte stream: bits that came and were not used yet.
struct Stream {
    coding: Coding,
    bits: usize, // of one value; 0: every value is the minimum
    bytes: Vec<u8>,
    bit: usize,
}

// Packets have 64 KiB; a stream that lags behind the others by far more is damaged.
const MOST_BUFFERED: usize = 4 << 20;

impl Stream {
    fn new(data: &RecordDataType) -> Self {
        let whole_bits = |min: i64, max: i64| (128 - (max as i128 - min as i128).leading_zeros()) as usize;
        let (coding, bits) = match data {
            RecordDataType::Single { .. } => (Coding::Single, 32),
            RecordDataType::Double { .. } => (Coding::Double, 64),
            RecordDataType::Integer { min, max } => (Coding::Whole { min: *min }, whole_bits(*min, *max)),
            RecordDataType::ScaledInteger { min, max, scale, offset } => {
                (Coding::Scaled { min: *min, scale: *scale, offset: *offset }, whole_bits(*min, *max))
            }
        };
        Self { coding, bits, bytes: Vec::new(), bit: 0 }
    }

    fn available(&self) -> usize {
        (self.bytes.len() * 8 - self.bit).checked_div(self.bits).unwrap_or(usize::MAX)
    }

    fn append(&mut self, bytes: &[u8]) {
        if self.bits == 0 {
            return;
        }
        self.bytes.drain(..self.bit / 8);
        self.bit %= 8;
        self.bytes.extend_from_slice(bytes);
    }

    fn next_bits(&mut self) -> u64 {
        if self.bits == 0 {
            return 0;
        }
        let begin = self.bit / 8;
        let mut word = [0u8; 16];
        if begin + 16 <= self.bytes.len() {
            word.copy_from_slice(&self.bytes[begin..begin + 16]);
        } else {
            let left = self.bytes.len() - begin;
            word[..left].copy_from_slice(&self.bytes[begin..]);
        }
        let value = (u128::from_le_bytes(word) >> (self.bit % 8)) as u64;
        self.bit += self.bits;
        if self.bits == 64 {
            value
        } else {
            value & ((1u64 << self.bits) - 1)
        }
    }

    fn take(&mut self, count: usize, column: &mut Column) {
        column.whole.clear();
        column.real.clear();
        column.is_whole = matches!(self.coding, Coding::Whole { .. });
        for _ in 0..count {
            let bits = self.next_bits();
            match self.coding {
                Coding::Single => column.real.push(f32::from_bits(bits as u32) as f64),
                Coding::Double => column.real.push(f64::from_bits(bits)),
                Coding::Whole { min } => column.whole.push(min.wrapping_add(bits as i64)),
                Coding::Scaled { min, scale, offset } => column.real.push(min.wrapping_add(bits as i64) as f64 * scale + offset),
            }
        }
    }
}

#[derive(Default)]
struct Column {
    is_whole: bool,
    whole: Vec<i64>,
    real: Vec<f64>,
}

impl Column {
    fn real(&self, i: usize) -> f64 {
        if self.is_whole {
            self.whole[i] as f64
        } else {
            self.real[i]
        }
    }
    fn is_set(&self, i: usize) -> bool {
        self.real(i) != 0.0
    }
}

type Index = Option<usize>;

fn find(cloud: &PointCloud, name: RecordName) -> Index {
    cloud.prototype.iter().position(|record| record.name == name)
}

fn find_all(cloud: &PointCloud, names: [RecordName; 3]) -> Option<[usize; 3]> {
    let [a, b, c] = names.map(|name| find(cloud, name));
    Some([a?, b?, c?])
}

fn is_normal(name: &RecordName, axis: &str) -> bool {
    matches!(name, RecordName::Unknown { name, .. } if name == axis)
}

fn find_normal(cloud: &PointCloud) -> Option<[usize; 3]> {
    let at = |axis: &str| cloud.prototype.iter().position(|record| is_normal(&record.name, axis));
    Some([at("normalX")?, at("normalY")?, at("normalZ")?])
}

/// Position of the file from position of the scan.
#[derive(Clone, Copy)]
struct Pose {
    turn: [[f64; 3]; 3],
    shift: [f64; 3],
}

impl Pose {
    fn of(cloud: &PointCloud) -> Result<Option<Self>, String> {
        let Some(pose) = &cloud.transform else { return Ok(None) };
        let (q, t) = (&pose.rotation, &pose.translation);
        let length = (q.w * q.w + q.x * q.x + q.y * q.y + q.z * q.z).sqrt();
        if !(length > 0.5 && length < 2.0) || !(t.x + t.y + t.z).is_finite() {
            return Err(format!("pose with the quaternion {} {} {} {} and translation {} {} {}, expected a unit quaternion and finite numbers", q.w, q.x, q.y, q.z, t.x, t.y, t.z));
        }
        let (w, x, y, z) = (q.w / length, q.x / length, q.y / length, q.z / length);
        let turn = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ];
        Ok(Some(Self { turn, shift: [t.x, t.y, t.z] }))
    }

    fn turned(&self, v: [f64; 3]) -> [f64; 3] {
        self.turn.map(|row| row[0] * v[0] + row[1] * v[1] + row[2] * v[2])
    }

    fn moved(&self, p: [f64; 3]) -> [f64; 3] {
        let turned = self.turned(p);
        [turned[0] + self.shift[0], turned[1] + self.shift[1], turned[2] + self.shift[2]]
    }
}

/// Colours from `min` to `max` in the file are 0 to 65535 here.
#[derive(Clone, Copy)]
struct ColourRange {
    min: f64,
    max: f64,
}

impl ColourRange {
    fn of(limits: Option<(&Option<RecordValue>, &Option<RecordValue>)>, data: &RecordDataType) -> Self {
        let value = |v: &Option<RecordValue>| v.as_ref().and_then(|v| v.to_f64(data).ok());
        let valid = |min: f64, max: f64| (min.is_finite() && max.is_finite() && max > min).then_some(Self { min, max });
        if let Some(range) = limits.and_then(|(min, max)| valid(value(min)?, value(max)?)) {
            return range;
        }
        let declared = match data {
            RecordDataType::Single { min: Some(min), max: Some(max) } => valid(*min as f64, *max as f64),
            RecordDataType::Double { min: Some(min), max: Some(max) } => valid(*min, *max),
            RecordDataType::ScaledInteger { min, max, scale, offset } => valid(*min as f64 * scale + offset, *max as f64 * scale + offset),
            RecordDataType::Integer { min, max } if (*max as i128 - *min as i128) < 1 << 32 => valid(*min as f64, *max as f64),
            _ => None,
        };
        let whole = matches!(data, RecordDataType::Integer { .. });
        declared.unwrap_or(Self { min: 0.0, max: if whole { 255.0 } else { 1.0 } })
    }

    fn encode(&self, value: f64) -> u16 {
        ((value - self.min) / (self.max - self.min) * 65535.0 + 0.5).clamp(0.0, 65535.0) as u16 // NaN becomes 0
    }
}

struct ExtraColumn {
    from: Index, // none: this scan does not have it
    invalid: Index,
    add: i64,
    is_scan_number: bool,
}

struct Scan {
    number: usize, // in the file, from 1
    section: u64,
    records: u64,
    prototype: Vec<RecordDataType>,
    cartesian: Option<[usize; 3]>,
    spherical: Option<[usize; 3]>,
    invalid: Index,
    colour: Option<[usize; 3]>,
    colour_range: [ColourRange; 3],
    colour_invalid: Index,
    normal: Option<[usize; 3]>,
    pose: Option<Pose>,
    extras: Vec<ExtraColumn>,
}

pub struct Input {
    pub descriptor: i32,
    pub file_bytes: u64,
    pub no_position_bits: u64,
}

/// Reading position in one scan.
struct Cursor {
    streams: Vec<Stream>,
    left: u64,
    end: u64, // physical, of the section
}

pub struct Scans {
    pub properties: Vec<Property>,
    pub declared: u64,
    pub has_normal: bool,
    pub has_colour: bool,
    pub colour_is_16_bit: bool,
    pub position_is_double: bool,
    no_position_bits: u64,
    scans: Vec<Scan>,
    pages: Pages,
    next_scan: usize,
    cursor: Option<Cursor>,
    columns: Vec<Column>,
    packet: Vec<u8>,
}

pub struct Output<'a> {
    pub positions: &'a mut [f64], // 3 a point
    pub normals: &'a mut [f32],   // 3 a point, or empty
    pub colours: &'a mut [u16],   // 3 a point, or empty
    pub extras: &'a mut [u8],
}

const GREY: u16 = 128 * 257; // a point without colour, as elsewhere
const MOST_FIELDS: usize = 256;
const AT_ONCE: usize = 4096;

fn check_header(input: &Input) -> Result<(), String> {
    let mut head = [0u8; 48];
    if input.file_bytes < PAGE_BYTES {
        return Err(format!("{} bytes, an E57 file has {PAGE_BYTES} or more", input.file_bytes));
    }
    FileAt::range(input.descriptor, 0, input.file_bytes).read_at(0, &mut head).map_err(|error| error.to_string())?;
    let at = |offset: usize| u64::from_le_bytes(head[offset..offset + 8].try_into().unwrap_or_default());
    if at(16) != input.file_bytes {
        return Err(format!("offset 16: the header declares {} bytes, the file has {}", at(16), input.file_bytes));
    }
    // The crate allocates this much.
    if at(32) > input.file_bytes {
        return Err(format!("offset 32: the header declares {} bytes of XML in a file of {}", at(32), input.file_bytes));
    }
    Ok(())
}

fn make_scan(number: usize, cloud: &PointCloud, input: &Input) -> Result<Scan, String> {
    let fields = cloud.prototype.len();
    if fields == 0 || fields > MOST_FIELDS {
        return Err(format!("{fields} values per point, expected 1 to {MOST_FIELDS}"));
    }
    let cartesian = find_all(cloud, [RecordName::CartesianX, RecordName::CartesianY, RecordName::CartesianZ]);
    let spherical = find_all(cloud, [RecordName::SphericalRange, RecordName::SphericalAzimuth, RecordName::SphericalElevation]);
    if cartesian.is_none() && spherical.is_none() {
        return Err("neither cartesianX, Y and Z nor sphericalRange, Azimuth and Elevation".to_string());
    }
    let bits: u64 = cloud.prototype.iter().map(|record| Stream::new(&record.data_type).bits as u64).sum();
    if bits == 0 {
        return Err("every value of its points is constant".to_string());
    }
    let most = input.file_bytes * 8 / bits;
    if cloud.records > most {
        return Err(format!("declares {} points of {bits} bits, a file of {} bytes holds at most {most}", cloud.records, input.file_bytes));
    }
    let colour = find_all(cloud, [RecordName::ColorRed, RecordName::ColorGreen, RecordName::ColorBlue]);
    let mut colour_range = [ColourRange { min: 0.0, max: 1.0 }; 3];
    if let Some(colour) = colour {
        let limits = cloud.color_limits.as_ref();
        let data = |k: usize| &cloud.prototype[colour[k]].data_type;
        colour_range = [
            ColourRange::of(limits.map(|l| (&l.red_min, &l.red_max)), data(0)),
            ColourRange::of(limits.map(|l| (&l.green_min, &l.green_max)), data(1)),
            ColourRange::of(limits.map(|l| (&l.blue_min, &l.blue_max)), data(2)),
        ];
    }
    Ok(Scan {
        number,
        section: cloud.file_offset,
        records: cloud.records,
        prototype: cloud.prototype.iter().map(|record| record.data_type.clone()).collect(),
        cartesian,
        spherical,
        invalid: find(cloud, if cartesian.is_some() { RecordName::CartesianInvalidState } else { RecordName::SphericalInvalidState }),
        colour,
        colour_range,
        colour_invalid: find(cloud, RecordName::IsColorInvalid),
        normal: find_normal(cloud),
        pose: Pose::of(cloud)?,
        extras: Vec::new(),
    })
}

/// Names of our extras for what has a meaning, in the order in which they come.
const KNOWN: [(RecordName, &str, Option<RecordName>, i64); 6] = [
    (RecordName::Intensity, "intensity", Some(RecordName::IsIntensityInvalid), 0),
    (RecordName::RowIndex, "row", None, 0),
    (RecordName::ColumnIndex, "column", None, 0),
    (RecordName::ReturnIndex, "return_number", None, 1), // from 0 in E57, from 1 elsewhere
    (RecordName::ReturnCount, "number_of_returns", None, 0),
    (RecordName::TimeStamp, "time_stamp", Some(RecordName::IsTimeStampInvalid), 0),
];

fn printable(name: &str) -> String {
    name.chars().map(|c| if c.is_ascii_graphic() { c } else { '_' }).take(64).collect()
}

/// Attributes that are carried under a name of their own, over all scans, in the order in which they appear.
fn other_names(clouds: &[&PointCloud]) -> Vec<RecordName> {
    let mut names: Vec<RecordName> = Vec::new();
    for cloud in clouds {
        let has_normal = find_normal(cloud).is_some();
        for record in &cloud.prototype {
            let is_other = matches!(record.name, RecordName::Unknown { .. });
            let is_part = has_normal && ["normalX", "normalY", "normalZ"].iter().any(|axis| is_normal(&record.name, axis));
            if is_other && !is_part && !names.contains(&record.name) {
                names.push(record.name.clone());
            }
        }
    }
    names
}

struct Wanted {
    record: RecordName,
    name: String,
    invalid: Option<RecordName>,
    add: i64,
}

fn wanted_attributes(clouds: &[&PointCloud]) -> Vec<Wanted> {
    let mut wanted: Vec<Wanted> = KNOWN
        .iter()
        .map(|(record, name, invalid, add)| Wanted { record: record.clone(), name: name.to_string(), invalid: invalid.clone(), add: *add })
        .collect();
    for record in other_names(clouds) {
        if let RecordName::Unknown { namespace, name } = &record {
            let name = printable(&if namespace.is_empty() { name.clone() } else { format!("{namespace}_{name}") });
            wanted.push(Wanted { record, name, invalid: None, add: 0 });
        }
    }
    wanted
}

impl Scans {
    pub fn open(input: &Input) -> Result<Self, String> {
        check_header(input)?;
        let reader = E57Reader::new(FileAt::range(input.descriptor, 0, input.file_bytes)).map_err(|error| describe(&error))?;
        let all = reader.pointclouds();
        let mut opened = Self {
            properties: Vec::new(),
            declared: 0,
            has_normal: false,
            has_colour: false,
            colour_is_16_bit: false,
            position_is_double: false,
            no_position_bits: input.no_position_bits,
            scans: Vec::new(),
            pages: Pages::new(input.descriptor, input.file_bytes),
            next_scan: 0,
            cursor: None,
            columns: Vec::new(),
            packet: Vec::new(),
        };
        let mut clouds = Vec::new();
        for (i, cloud) in all.iter().enumerate() {
            if cloud.records == 0 {
                continue;
            }
            let scan = make_scan(i + 1, cloud, input).map_err(|what| format!("scan {} of {}: {what}", i + 1, all.len()))?;
            opened.describe_scan(&scan);
            opened.scans.push(scan);
            clouds.push(cloud);
        }
        if opened.scans.is_empty() {
            return Err(format!("holds no points ({} scans)", all.len()));
        }
        opened.has_normal = opened.scans.iter().any(|scan| scan.normal.is_some());
        opened.choose_properties(&clouds)?;
        Ok(opened)
    }

    fn describe_scan(&mut self, scan: &Scan) {
        self.declared += scan.records;
        self.has_colour |= scan.colour.is_some();
        self.colour_is_16_bit |= scan.colour.is_some() && scan.colour_range.iter().any(|range| range.max != 255.0);
        let coordinates = scan.cartesian.or(scan.spherical).unwrap_or_default();
        let singles = coordinates.iter().all(|i| matches!(scan.prototype[*i], RecordDataType::Single { .. }));
        self.position_is_double |= !singles || scan.pose.is_some();
    }

    fn choose_properties(&mut self, clouds: &[&PointCloud]) -> Result<(), String> {
        let mut names: Vec<String> = ["x", "y", "z", "nx", "ny", "nz", "red", "green", "blue"].map(String::from).to_vec();
        for wanted in wanted_attributes(clouds) {
            let kinds = clouds.iter().filter_map(|cloud| find(cloud, wanted.record.clone()).map(|i| Kind::of(&cloud.prototype[i].data_type)));
            let Some(mut kind) = kinds.reduce(Kind::join) else { continue };
            if let Kind::Whole { min, max } = &mut kind {
                *min = min.saturating_add(wanted.add);
                *max = max.saturating_add(wanted.add);
            }
            let mut scalar = kind.scalar();
            if wanted.name == "intensity" && scalar == Scalar::U8 {
                scalar = Scalar::U16; // as LAS has it
            }
            self.add_property(wanted.name, scalar, kind, &mut names);
            for (scan, cloud) in self.scans.iter_mut().zip(clouds) {
                let invalid = wanted.invalid.clone().and_then(|name| find(cloud, name));
                scan.extras.push(ExtraColumn { from: find(cloud, wanted.record.clone()), invalid, add: wanted.add, is_scan_number: false });
            }
        }
        if self.scans.len() > 1 {
            let last = self.scans.last().map_or(0, |scan| scan.number as i64);
            let kind = Kind::Whole { min: 0, max: last.max(256) }; // 16 bits, that files of few and of many scans are alike
            self.add_property("scan".to_string(), kind.scalar(), kind, &mut names);
            for scan in &mut self.scans {
                scan.extras.push(ExtraColumn { from: None, invalid: None, add: 0, is_scan_number: true });
            }
        }
        let bytes: usize = self.properties.iter().map(|property| property.scalar.bytes()).sum();
        if bytes > 1 << 14 {
            return Err(format!("{bytes} bytes of attributes per point"));
        }
        Ok(())
    }

    fn add_property(&mut self, name: String, scalar: Scalar, kind: Kind, names: &mut Vec<String>) {
        let mut unique = name.clone();
        let mut k = 2;
        while names.contains(&unique) {
            unique = format!("{name}_{k}");
            k += 1;
        }
        names.push(unique.clone());
        self.properties.push(Property { name: unique, scalar, kind });
    }

    pub fn extra_bytes(&self) -> usize {
        self.properties.iter().map(|property| property.scalar.bytes()).sum()
    }

    /// The next points, at most output.positions.len() / 3; 0 at the end.
    pub fn read(&mut self, output: &mut Output) -> Result<usize, String> {
        let most = output.positions.len() / 3;
        let mut done = 0;
        while done < most {
            if self.cursor.as_ref().is_none_or(|cursor| cursor.left == 0) {
                if self.next_scan >= self.scans.len() {
                    break;
                }
                self.begin_scan()?;
            }
            let count = self.fill_columns(most - done)?;
            self.write_points(count, done, output);
            done += count;
        }
        Ok(done)
    }

    fn fail(&self, what: String) -> String {
        format!("scan {}: {what}", self.scans[self.next_scan - 1].number)
    }

    fn begin_scan(&mut self) -> Result<(), String> {
        let scan = &self.scans[self.next_scan];
        self.next_scan += 1;
        let streams: Vec<Stream> = scan.prototype.iter().map(Stream::new).collect();
        let (section, left) = (scan.section, scan.records);
        self.columns = (0..streams.len()).map(|_| Column::default()).collect();
        let mut head = [0u8; 32];
        self.pages.seek_physical(section).and_then(|()| self.pages.read(&mut head)).map_err(|what| self.fail(what))?;
        let at = |offset: usize| u64::from_le_bytes(head[offset..offset + 8].try_into().unwrap_or_default());
        if head[0] != 1 {
            return Err(self.fail(format!("offset {section}: section of type {}, expected 1 (compressed vector)", head[0])));
        }
        let end = section.saturating_add(at(8)); // physical, as libE57 writes it; some writers give the logical length, so it only ends errors
        self.pages.seek_physical(at(16)).map_err(|what| self.fail(format!("offset {}: its points: {what}", section + 16)))?;
        self.cursor = Some(Cursor { streams, left, end });
        Ok(())
    }

    /// Decodes the next points of the scan into the columns; at least one.
    fn fill_columns(&mut self, most: usize) -> Result<usize, String> {
        loop {
            let cursor = self.cursor.as_mut().ok_or("no scan")?;
            let available = cursor.streams.iter().map(Stream::available).min().unwrap_or(0);
            let count = (available.min(most).min(AT_ONCE) as u64).min(cursor.left) as usize;
            if count > 0 {
                for (stream, column) in cursor.streams.iter_mut().zip(&mut self.columns) {
                    stream.take(count, column);
                }
                cursor.left -= count as u64;
                return Ok(count);
            }
            let at = self.pages.physical();
            self.next_packet().map_err(|what| {
                let (left, end) = self.cursor.as_ref().map_or((0, 0), |cursor| (cursor.left, cursor.end));
                let records = self.scans[self.next_scan - 1].records;
                self.fail(format!("offset {at}: {what} ({} of {records} points read; the section ends at {end})", records - left))
            })?;
        }
    }

    // Index packets and such are passed over.
    fn next_packet(&mut self) -> Result<(), String> {
        let mut head = [0u8; 4];
        self.pages.read(&mut head)?;
        let bytes = u16::from_le_bytes([head[2], head[3]]) as usize + 1;
        if head[0] > 2 || bytes % 4 != 0 || bytes < 8 {
            return Err(format!("packet of type {} and {bytes} bytes, expected type 0 to 2 and a multiple of 4", head[0]));
        }
        self.packet.resize(bytes - 4, 0);
        self.pages.read(&mut self.packet)?;
        if head[0] != 1 {
            return Ok(());
        }
        let cursor = self.cursor.as_mut().ok_or("no scan")?;
        let count = u16::from_le_bytes([self.packet[0], self.packet[1]]) as usize;
        let mut at = 2 + 2 * count;
        if count != cursor.streams.len() || at > self.packet.len() {
            return Err(format!("packet with {count} streams in {bytes} bytes, expected {}", cursor.streams.len()));
        }
        for (i, stream) in cursor.streams.iter_mut().enumerate() {
            let size = u16::from_le_bytes([self.packet[2 + 2 * i], self.packet[3 + 2 * i]]) as usize;
            if size > self.packet.len() - at {
                return Err(format!("stream {} of the packet has {size} bytes, {} are left", i + 1, self.packet.len() - at));
            }
            stream.append(&self.packet[at..at + size]);
            if stream.bytes.len() > MOST_BUFFERED {
                return Err(format!("stream {} is {} bytes ahead of the others", i + 1, stream.bytes.len()));
            }
            at += size;
        }
        Ok(())
    }

    fn write_points(&self, count: usize, first: usize, output: &mut Output) {
        let scan = &self.scans[self.next_scan - 1];
        self.write_positions(scan, count, &mut output.positions[3 * first..3 * (first + count)]);
        if self.has_normal {
            self.write_normals(scan, count, &mut output.normals[3 * first..3 * (first + count)]);
        }
        if self.has_colour {
            self.write_colours(scan, count, &mut output.colours[3 * first..3 * (first + count)]);
        }
        let row = self.extra_bytes();
        let mut at = 0;
        for (k, property) in self.properties.iter().enumerate() {
            let rows = output.extras[row * first..row * (first + count)].chunks_exact_mut(row);
            self.write_extra(scan, k, rows.map(|row| &mut row[at..at + property.scalar.bytes()]));
            at += property.scalar.bytes();
        }
    }

    fn triple(&self, at: [usize; 3], i: usize) -> [f64; 3] {
        at.map(|k| self.columns[k].real(i))
    }

    fn write_positions(&self, scan: &Scan, count: usize, to: &mut [f64]) {
        let nowhere = f64::from_bits(self.no_position_bits);
        for (i, to) in to.chunks_exact_mut(3).enumerate().take(count) {
            if scan.invalid.is_some_and(|k| self.columns[k].is_set(i)) {
                to.fill(nowhere); // a direction without distance is no point either
                continue;
            }
            let point = match (scan.cartesian, scan.spherical) {
                (Some(at), _) => self.triple(at, i),
                (None, Some(at)) => {
                    let [range, azimuth, elevation] = self.triple(at, i);
                    let flat = range * elevation.cos();
                    [flat * azimuth.cos(), flat * azimuth.sin(), range * elevation.sin()]
                }
                (None, None) => [f64::NAN; 3],
            };
            to.copy_from_slice(&scan.pose.map_or(point, |pose| pose.moved(point)));
        }
    }

    fn write_normals(&self, scan: &Scan, count: usize, to: &mut [f32]) {
        for (i, to) in to.chunks_exact_mut(3).enumerate().take(count) {
            let normal = scan.normal.map_or([0.0; 3], |at| self.triple(at, i)); // zero: none
            let normal = scan.pose.map_or(normal, |pose| pose.turned(normal));
            to.copy_from_slice(&normal.map(|v| v as f32));
        }
    }

    fn write_colours(&self, scan: &Scan, count: usize, to: &mut [u16]) {
        for (i, to) in to.chunks_exact_mut(3).enumerate().take(count) {
            match scan.colour {
                Some(at) if !scan.colour_invalid.is_some_and(|k| self.columns[k].is_set(i)) => {
                    for k in 0..3 {
                        to[k] = scan.colour_range[k].encode(self.columns[at[k]].real(i));
                    }
                }
                _ => to.fill(GREY),
            }
        }
    }

    fn write_extra<'a>(&self, scan: &Scan, property: usize, rows: impl Iterator<Item = &'a mut [u8]>) {
        let extra = &scan.extras[property];
        let Property { scalar, kind, .. } = &self.properties[property];
        let floats = !matches!(kind, Kind::Whole { .. });
        for (i, to) in rows.enumerate() {
            let missing = extra.from.is_none() || extra.invalid.is_some_and(|k| self.columns[k].is_set(i));
            if floats {
                let value = if missing { f64::NAN } else { extra.from.map_or(f64::NAN, |k| self.columns[k].real(i)) + extra.add as f64 };
                match scalar {
                    Scalar::F32 => to.copy_from_slice(&(value as f32).to_le_bytes()),
                    _ => to.copy_from_slice(&value.to_le_bytes()),
                }
            } else {
                let value = match extra.from {
                    _ if extra.is_scan_number => scan.number as i64,
                    Some(k) if !missing => self.columns[k].whole[i].wrapping_add(extra.add),
                    _ => 0,
                };
                let bytes = value.to_le_bytes();
                to.copy_from_slice(&bytes[..scalar.bytes()]);
            }
        }
    }
}

/// The crate's message with what lies behind it.
fn describe(error: &e57::Error) -> String {
    let mut text = error.to_string();
    let mut source = std::error::Error::source(error);
    while let Some(inner) = source {
        text += &format!(": {inner}");
        source = inner.source();
    }
    text
}
