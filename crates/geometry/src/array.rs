//! Arrays that lie in memory of their own, or in memory that someone else holds.
//!
//! The triangles and hierarchies of a scene that is larger than memory lie in a file that is mapped
//! ([`Array::within`]); those of any other scene in vectors. Walks must not pay for that choice: an
//! [`Array`] keeps where its elements start and how many they are, so reading it costs what reading a
//! vector costs.
//!
//! Invariants, on which the unsafe code of this module rests:
//! - `start` and `len` are those of a slice of initialised `T` that does not move and is not written
//!   to until the array is dropped;
//! - without a holder, they and `capacity` are the parts of a vector that the array owns;
//! - with a holder, the slice lies in what the holder's `as_ref` gave once; [`Holder`] promises that
//!   this stays where it is while the holder lives, and the array keeps it alive.
#![allow(unsafe_code)]

use std::{fmt, marker::PhantomData, mem::ManuallyDrop, ops::Deref, ptr::NonNull, sync::Arc};

use bytemuck::AnyBitPattern;

/// Something that holds bytes for arrays.
///
/// # Safety
/// `bytes` must give the same slice, at the same place and with the same content, as long as the holder
/// lives, on whatever thread.
pub unsafe trait Holder: Send + Sync {
    /// The bytes.
    fn bytes(&self) -> &[u8];
}

/// Elements that do not change; read as a slice.
pub struct Array<T> {
    start: NonNull<T>,
    len: usize,
    /// Of the vector, where the array owns one.
    capacity: usize,
    /// Who holds the elements, where the array does not own them.
    holder: Option<Arc<dyn Holder>>,
    owns: PhantomData<T>,
}

// Sound: an array gives no access but by shared references, and its holder may be shared.
unsafe impl<T: Send> Send for Array<T> {}
unsafe impl<T: Sync> Sync for Array<T> {}

impl<T> Array<T> {
    /// The elements as a vector; copies those that a holder has.
    #[must_use]
    pub fn into_vec(self) -> Vec<T>
    where
        T: Clone,
    {
        if self.holder.is_some() {
            return self.to_vec();
        }
        let parts = ManuallyDrop::new(self);
        // Sound: the parts of a vector, which the array does not drop now; without a holder there is
        // nothing else to drop.
        unsafe { Vec::from_raw_parts(parts.start.as_ptr(), parts.len, parts.capacity) }
    }
}

impl<T: AnyBitPattern> Array<T> {
    /// The `len` elements that begin at byte `offset` of what a holder has; `None` where they do not
    /// lie within it, or not at a multiple of their alignment.
    #[must_use]
    pub fn within(holder: Arc<dyn Holder>, offset: usize, len: usize) -> Option<Self> {
        let end = len.checked_mul(size_of::<T>())?.checked_add(offset)?;
        let elements: &[T] = bytemuck::try_cast_slice(holder.bytes().get(offset..end)?).ok()?;
        let start = NonNull::from(elements).cast();
        Some(Self { start, len, capacity: 0, holder: Some(holder), owns: PhantomData })
    }
}

impl<T> Deref for Array<T> {
    type Target = [T];

    #[inline(always)]
    fn deref(&self) -> &[T] {
        // Sound by the invariants of the module.
        unsafe { std::slice::from_raw_parts(self.start.as_ptr(), self.len) }
    }
}

impl<T> Drop for Array<T> {
    fn drop(&mut self) {
        if self.holder.is_none() {
            // Sound: the parts of a vector, taken apart by `from`, and dropped only here.
            drop(unsafe { Vec::from_raw_parts(self.start.as_ptr(), self.len, self.capacity) });
        }
    }
}

impl<T> From<Vec<T>> for Array<T> {
    fn from(vector: Vec<T>) -> Self {
        let mut parts = ManuallyDrop::new(vector);
        let start = NonNull::new(parts.as_mut_ptr()).expect("a vector's pointer is never null");
        let (len, capacity) = (parts.len(), parts.capacity());
        Self { start, len, capacity, holder: None, owns: PhantomData }
    }
}

impl<T> FromIterator<T> for Array<T> {
    fn from_iter<I: IntoIterator<Item = T>>(elements: I) -> Self {
        Self::from(Vec::from_iter(elements))
    }
}

impl<T> Default for Array<T> {
    fn default() -> Self {
        Self::from(Vec::new())
    }
}

impl<T: Clone> Clone for Array<T> {
    fn clone(&self) -> Self {
        match &self.holder {
            None => Self::from(self.to_vec()),
            Some(holder) => Self { holder: Some(Arc::clone(holder)), owns: PhantomData, ..*self },
        }
    }
}

impl<T: fmt::Debug> fmt::Debug for Array<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        (**self).fmt(f)
    }
}

impl<T: PartialEq> PartialEq for Array<T> {
    fn eq(&self, other: &Self) -> bool {
        **self == **other
    }
}

impl<T: Eq> Eq for Array<T> {}

impl<'a, T> IntoIterator for &'a Array<T> {
    type Item = &'a T;
    type IntoIter = std::slice::Iter<'a, T>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Held(Vec<u64>);

    // Sound: nothing changes the vector.
    unsafe impl Holder for Held {
        fn bytes(&self) -> &[u8] {
            bytemuck::cast_slice(&self.0)
        }
    }

    #[test]
    fn an_array_outlives_whoever_else_knows_its_holder() {
        let holder = Arc::new(Held(vec![1, 2, 3, 4]));
        let weak = Arc::downgrade(&holder);
        let array: Array<u64> = Array::within(holder, 8, 2).expect("it is there");
        assert_eq!(*array, [2, 3]);
        let copy = array.clone();
        drop(array);
        assert_eq!(copy.iter().sum::<u64>(), 5);
        assert_eq!(copy.into_vec(), [2, 3]);
        assert!(weak.upgrade().is_none(), "the last array lets go of it");
    }

    #[test]
    fn what_is_not_there_is_refused() {
        let holder = || Arc::new(Held(vec![0; 4]));
        assert!(Array::<u64>::within(holder(), 8, 4).is_none(), "beyond the end");
        assert!(Array::<u64>::within(holder(), 4, 1).is_none(), "not aligned");
        assert!(Array::<u64>::within(holder(), 0, usize::MAX).is_none());
        assert!(Array::<u32>::within(holder(), 4, 7).is_some());
        assert!(Array::<u64>::within(holder(), 32, 0).is_some_and(|a| a.is_empty()));
    }

    #[test]
    fn a_vector_comes_back_as_it_was() {
        let words = vec!["a".to_owned(), "b".to_owned()];
        let array = Array::from(words.clone());
        let other = array.clone();
        assert_eq!(array, other);
        assert_eq!(array.into_vec(), words);
        assert_eq!(other.first().map(String::as_str), Some("a"));
        assert!(Array::<String>::default().is_empty());
    }
}
